"""The state of a robot: from a state file, or from a rollout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydantic

from clamber.errors import InputError, read_yaml, validated
from clamber.model.world import World
from clamber.planning.records import Plan
from clamber.run.folder import load_rollout


class StateFile(pydantic.BaseModel):
    """A state as a person writes it, in YAML or JSON.

    `position` and `quaternion` of the base, `joints` by name, `contacts` as supports by
    surface.
    """

    model_config = pydantic.ConfigDict(extra="forbid")
    version: int = 1
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    joints: dict[str, float]
    contacts: dict[str, str] | None = None


def load_state(
    plan: Plan, folder: str | Path, where: str
) -> tuple[np.ndarray, dict[str, str] | None]:
    """Posture (nq,) and the support of each surface in contact, None if not said.

    Args:
        plan: That the robot was following.
        folder: Its run.
        where: A `StateFile`, or a time of the run's rollout [s].

    Raises:
        InputError: The file or one of its fields cannot be used, or nothing was
            recorded at that time.
    """
    try:
        seconds = float(where)
    except ValueError:
        return _state_of(plan.world, Path(where))
    rollout = load_rollout(folder)
    if not 0.0 <= seconds <= rollout.time[-1]:
        text = f"a time of the rollout, 0 to {rollout.time[-1]:g} s"
        raise InputError(text, "--from", value=seconds)
    return rollout.qpos[int(np.searchsorted(rollout.time, seconds))], None


def _state_of(world: World, path: Path) -> tuple[np.ndarray, dict[str, str] | None]:
    state = validated(StateFile, read_yaml(path), path)
    numbers = (*state.position, *state.quaternion, *state.joints.values())
    if not np.all(np.isfinite(numbers)):
        raise InputError("finite numbers only", source=path)
    size = float(np.linalg.norm(state.quaternion))
    if abs(size - 1.0) > 0.01:
        text = "a unit quaternion, w first"
        raise InputError(text, path, "quaternion", state.quaternion)
    for name in (*state.joints, *world.joints):
        if (name in state.joints) != (name in world.joints):
            text = f"the joints of {world.robot.name}: {', '.join(world.joints)}"
            value = state.joints.get(name, "missing")
            raise InputError(text, path, f"joints.{name}", value)
    q = world.home.copy()
    q[:3], q[3:7] = state.position, np.array(state.quaternion) / size
    q[world.qadr] = [state.joints[n] for n in world.joints]
    return q, state.contacts
