"""The folder of a proposed robot: what proposes it is slow to import."""

from __future__ import annotations

from pathlib import Path

from clamber.model.arguments import checks_types
from clamber.model.propose import Proposal, robot_yaml
from clamber.model.robot import ROBOT_FILE
from clamber.model.shapes import MESH_FOLDER
from clamber.run.codec import whole_file


@checks_types
def save_proposal(proposal: Proposal, folder: str | Path) -> None:
    """Write `robot.yaml`, the model that it names, and meshes into a folder.

    Args:
        proposal: The proposal.
        folder: An existing folder.
    """
    files = {f"{MESH_FOLDER}/{n}": content for n, content in proposal.files.items()}
    files[proposal.fields["model"]] = proposal.mjcf.encode()
    files[ROBOT_FILE] = robot_yaml(proposal).encode()
    for name, content in files.items():
        path = Path(folder) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as draft:
            draft.write_bytes(content)
