"""Records of contacts refuse what cannot be."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from clamber.contact.contact import Contact, ContactSequence, Stance, region_of
from clamber.model.scene import Scene

FLAT = np.array([1.0, 0.0, 0.0, 0.0])


def contact(surface: str, support: str = "ground", x: float = 0.0) -> Contact:
    return Contact(
        surface=surface,
        support=support,
        position=np.array([x, 0.0, 0.0]),
        quaternion=FLAT,
    )


def sequence(stances: tuple[Stance, ...], t) -> ContactSequence:
    return ContactSequence(
        source="test",
        subject=None,
        scene=Scene.from_height(0.3),
        stances=stances,
        t=np.asarray(t, dtype=float),
    )


@pytest.mark.parametrize(
    ("supports", "region"),
    [
        ((), "G"),
        (("ground",), "G"),
        (("ground", "ground"), "G"),
        (("ground", "box"), "M"),
        (("box", "ground", "box"), "M"),
        (("box", "box"), "O"),
        (("box", "shelf"), "O"),  # two obstacles are no mixture
    ],
)
def test_the_region_is_ground_obstacle_or_mixed(supports, region):
    contacts = tuple(contact(f"S{i}", s) for i, s in enumerate(supports))
    assert region_of(contacts) == region
    assert Stance(contacts=contacts).region == region


def test_no_surface_is_in_two_places():
    with pytest.raises(ValueError, match=r"twice.*LHand"):
        Stance(contacts=(contact("LHand"), contact("RHand"), contact("LHand", x=0.5)))


def test_a_stance_finds_its_contacts_by_surface():
    left, right = contact("LHand", x=0.1), contact("RHand", x=0.2)
    stance = Stance(contacts=(left, right))
    assert stance.surfaces == ("LHand", "RHand")
    assert stance.contact("RHand") is right
    assert stance.contact("LFoot") is None


def test_a_posture_names_known_directions():
    Stance(contacts=(), posture={"trunk": np.array([0.0, 0.0, 1.0])})
    with pytest.raises(ValueError, match="tail"):
        Stance(contacts=(), posture={"tail": np.array([0.0, 0.0, 1.0])})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position", [0.0, 0.0]),
        ("position", [[0.0, 0.0, 0.0]]),
        ("position", [0.0, np.nan, 0.0]),
        ("quaternion", [0.0, 0.0, 0.0]),
        ("quaternion", [np.inf, 0.0, 0.0, 0.0]),
    ],
)
def test_a_contact_has_a_finite_pose(field, value):
    pose = {"position": np.zeros(3), "quaternion": FLAT, field: np.array(value)}
    with pytest.raises(ValueError, match=field):
        Contact(surface="LHand", support="ground", **pose)


def test_arrays_are_copies_and_read_only():
    p, link = np.zeros(3), FLAT.copy()
    c = Contact(surface="A", support="box", position=p, quaternion=FLAT, link=link)
    p[0] = link[0] = 7.0
    assert c.position[0] == 0.0
    assert c.link is not None
    assert c.link[0] == 1.0
    for a in (c.position, c.quaternion, c.link):
        with pytest.raises(ValueError, match="read-only"):
            a[0] = 1.0
    with pytest.raises(FrozenInstanceError):
        c.surface = "B"  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    "t", [[0.0, 1.0], [0, 1, 2, 3], [0, 2, 1], [0, 1, 1], [0, 1, np.nan]]
)
def test_times_increase_and_are_one_more_than_stances(t):
    stances = (Stance(contacts=(contact("A"),)), Stance(contacts=()))
    with pytest.raises(ValueError, match="times must increase"):
        sequence(stances, t)
    assert not sequence(stances, [0.0, 0.5, 2.0]).t.flags.writeable


def test_a_sequence_stands_on_supports_of_its_scene():
    with pytest.raises(KeyError, match="no support 'table'"):
        sequence((Stance(contacts=(contact("A", "table"),)),), [0.0, 1.0])
