"""One recording of a person climbing over a box, made into a motion of a humanoid.

The public names are found in their modules on first use (PEP 562), so that importing
the package costs nothing; `__init__.pyi` tells type checkers the same.
"""

from __future__ import annotations

from importlib import import_module

from clamber.model.shown import shown_by

__version__ = "0.1.0"

_HOME = {
    "Alternative": "planning.substitutes",
    "Box": "model.scene",
    "Checkup": "planning.diagnose",
    "Budget": "planning.records",
    "Change": "step.change",
    "ClamberError": "errors",
    "Contact": "contact.contact",
    "ContactInterval": "contact.contact",
    "ContactSequence": "contact.contact",
    "Criterion": "execution.verdict",
    "DemoPolicy": "contact.policy",
    "Demonstration": "recording.demonstration",
    "Disturbance": "execution.disturbance",
    "Event": "execution.events",
    "Exported": "run.export",
    "Failure": "step.change",
    "Fallback": "planning.records",
    "GeneralPolicy": "contact.policy",
    "InputError": "errors",
    "Climb": "study.climb",
    "Kinematics": "model.kinematics",
    "MissingDependency": "errors",
    "Option": "contact.policy",
    "ClimbResult": "study.climb",
    "PelvisDistribution": "contact.policy",
    "Plan": "planning.records",
    "PlanOptions": "planning.records",
    "Proposal": "model.propose",
    "Ranked": "planning.planner",
    "Replanned": "planning.planner",
    "Reported": "show.report",
    "Robot": "model.robot",
    "Rollout": "execution.simulation",
    "Scene": "model.scene",
    "Spec": "study.spec",
    "Stance": "contact.contact",
    "State": "planning.records",
    "Status": "errors",
    "Support": "model.scene",
    "Trajectory": "planning.trajectory",
    "Verdict": "execution.verdict",
    "World": "model.world",
    "build_world": "model.world",
    "check_robot": "planning.diagnose",
    "check_scene": "planning.diagnose",
    "contact_alternatives": "planning.substitutes",
    "contact_differences": "planning.substitutes",
    "detect_contacts": "recording.detect",
    "draw_robot": "show.pictures",
    "draw_scene": "show.pictures",
    "export_run": "run.export",
    "judge": "execution.verdict",
    "learn_policy": "contact.learn",
    "limb_lengths": "model.kinematics",
    "load_demo": "recording.recording",
    "load_plan": "run.folder",
    "load_policy": "run.folder",
    "load_robot": "model.robot",
    "load_rollout": "run.folder",
    "load_scene": "model.terrain",
    "load_sequence": "run.folder",
    "load_spec": "study.spec",
    "load_sweep": "study.sweep",
    "open_view": "show.live",
    "new_run_folder": "run.folder",
    "pelvis_distribution": "contact.policy",
    "plan": "planning.planner",
    "plan_cost": "planning.substitutes",
    "propose_robot": "model.propose",
    "render_run": "show.pictures",
    "replan": "planning.planner",
    "run_climb": "study.climb",
    "run_sweep": "study.sweep",
    "save_curves": "study.curves",
    "save_plan": "run.folder",
    "save_policy": "run.folder",
    "save_proposal": "run.proposal",
    "save_rollout": "run.folder",
    "save_sequence": "run.folder",
    "save_verdict": "run.folder",
    "simulate": "execution.simulation",
    "state_of": "planning.start",
    "write_report": "show.report",
}

__all__ = ["__version__", *_HOME]

shown_by(lambda: import_module("clamber.show.notebook"))


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
