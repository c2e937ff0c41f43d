"""One recording of a person climbing over a box, made into a motion of a humanoid.

The public names are found in their modules on first use (PEP 562), so that importing
the package costs nothing; `__init__.pyi` tells type checkers the same.
"""

from __future__ import annotations

from importlib import import_module

__version__ = "0.1.0"

_HOME = {
    "Box": "scene",
    "ClamberError": "errors",
    "Contact": "contact",
    "ContactInterval": "contact",
    "ContactSequence": "contact",
    "Criterion": "simulation",
    "Demonstration": "demo",
    "Disturbance": "disturbance",
    "Event": "execution",
    "Exported": "export",
    "Infeasible": "errors",
    "InputError": "errors",
    "Job": "job",
    "Kinematics": "model",
    "MissingDependency": "errors",
    "Outcome": "job",
    "Plan": "pipeline",
    "PlanOptions": "pipeline",
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
    "detect_contacts": "detect",
    "export_run": "export",
    "judge": "simulation",
    "limb_lengths": "model",
    "load_demo": "demo",
    "load_plan": "io",
    "load_robot": "model",
    "load_rollout": "io",
    "load_scene": "scene",
    "load_sequence": "io",
    "load_spec": "experiment",
    "load_sweep": "sweep",
    "new_run_folder": "io",
    "plan": "pipeline",
    "render_run": "viz",
    "run_job": "job",
    "run_sweep": "sweep",
    "save_curves": "curves",
    "save_plan": "io",
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
