"""One recording of a person climbing over a box, made into a motion of a humanoid.

The public names are found in their modules on first use (PEP 562), so that importing
the package costs nothing; `__init__.pyi` tells type checkers the same.
"""

from __future__ import annotations

from importlib import import_module

__version__ = "0.1.0"

_HOME = {
    "Alternative": "alternatives",
    "Bounds": "exploration",
    "Box": "scene",
    "Checkup": "checkup",
    "ClamberError": "errors",
    "Contact": "contact",
    "ContactInterval": "contact",
    "ContactSequence": "contact",
    "Criterion": "simulation",
    "DemoPolicy": "policy",
    "Demonstration": "demo",
    "Disturbance": "disturbance",
    "Event": "execution",
    "Exported": "export",
    "GeneralPolicy": "policy",
    "Infeasible": "errors",
    "InputError": "errors",
    "Job": "job",
    "Kinematics": "model",
    "Midway": "pipeline",
    "MissingDependency": "errors",
    "Option": "policy",
    "Outcome": "job",
    "PelvisDistribution": "policy",
    "Plan": "pipeline",
    "PlanOptions": "pipeline",
    "Proposal": "proposal",
    "Ranked": "alternatives",
    "Replanned": "alternatives",
    "Reported": "report",
    "Robot": "model",
    "Rollout": "simulation",
    "Scene": "scene",
    "Spec": "experiment",
    "Stance": "contact",
    "Status": "errors",
    "Support": "scene",
    "Trajectory": "trajectory",
    "Verdict": "simulation",
    "World": "model",
    "build_world": "model",
    "check_robot": "checkup",
    "check_scene": "checkup",
    "contact_alternatives": "alternatives",
    "contact_differences": "alternatives",
    "detect_contacts": "detect",
    "draw_robot": "viz",
    "draw_scene": "viz",
    "export_run": "export",
    "judge": "simulation",
    "learn_policy": "contraction",
    "limb_lengths": "model",
    "load_demo": "demo",
    "load_plan": "io",
    "load_policy": "io",
    "load_robot": "model",
    "load_rollout": "io",
    "load_scene": "scene",
    "load_sequence": "io",
    "load_spec": "experiment",
    "load_sweep": "sweep",
    "midway_of": "alternatives",
    "open_view": "view",
    "new_run_folder": "io",
    "pelvis_distribution": "policy",
    "plan": "pipeline",
    "plan_cost": "alternatives",
    "plan_or_replan": "alternatives",
    "plan_traverse": "traverse",
    "propose_robot": "proposal",
    "render_run": "viz",
    "replan": "alternatives",
    "replan_rest": "alternatives",
    "run_job": "job",
    "run_sweep": "sweep",
    "save_curves": "curves",
    "save_plan": "io",
    "save_policy": "io",
    "save_proposal": "io",
    "save_rollout": "io",
    "save_sequence": "io",
    "save_verdict": "io",
    "simulate": "simulation",
    "write_c3d": "demo",
    "write_report": "report",
    "write_trc": "demo",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    """Import the module that has the name, once."""
    if name not in _HOME:
        raise AttributeError(f"module 'clamber' has no attribute {name!r}")
    value = getattr(import_module(f"clamber.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Names that `dir` and completion show."""
    return sorted(__all__)
