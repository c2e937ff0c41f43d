"""Names of joints and markers as many tools write them, with what each must mean."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from clamber.errors import InputError
from clamber.recording.recording import load_demo
from clamber.recording.skeleton import recognise, solve_centres

ORDER = ("Hip", "Knee", "Foot", "Shoulder", "Elbow", "Hand")
BOTH = {"L": ("left", "Left", "L", "l"), "R": ("right", "Right", "R", "r")}


def sided(words: str, form: str) -> list[str]:
    """Names of both sides; in `form` {a} left, {b} Left, {c} L, {d} l, {w} the word."""
    return [
        form.format(a=a, b=b, c=c, d=d, w=w)
        for a, b, c, d in BOTH.values()
        for w in words.split()
    ]


# What is recognised, the form, the words of ORDER, others of each side, of no side.
SKELETONS = {
    "Unreal": (
        "Unreal skeleton", "{w}_{d}", "thigh calf foot upperarm lowerarm hand",
        "ball clavicle index_01 middle_01 thigh_twist_01 calf_twist_01 "
        "upperarm_twist_01 ik_hand", "root pelvis spine_01 neck_01 head ik_foot_root",
    ),
    "Kinect 2": (
        "Kinect joints", "{w}{b}", "Hip Knee Ankle Shoulder Elbow Wrist",
        "Foot Hand HandTip Thumb", "SpineBase SpineMid SpineShoulder Neck Head",
    ),
    "Kinect Azure": (
        "Kinect joints", "{w}_{a}", "hip knee ankle shoulder elbow wrist",
        "foot hand handtip thumb clavicle eye ear",
        "pelvis spine_navel spine_chest neck head nose",
    ),
    "Blender": (
        "joints by their names", "{w}.{c}", "thigh shin foot upper_arm forearm hand",
        "toe shoulder heel.02 f_middle.01", "spine spine.001 spine.006",
    ),
    "Blender, deforming": (
        "joints by their names", "DEF-{w}.{c}",
        "thigh shin foot upper_arm forearm hand", "toe shoulder",
        "DEF-spine DEF-spine.001",
    ),
    "Xsens": (
        "Xsens joints", "j{b}{w}", "Hip Knee Ankle Shoulder Elbow Wrist",
        "BallFoot T4Shoulder",
        "jL5S1 jL4L3 jT1C7 jC1Head pLeftHeelFoot pRightToe pRightASI pSacrum",
    ),
    "Xsens segments": (
        "Xsens segments", "{b}{w}",
        "UpperLeg LowerLeg Foot UpperArm ForeArm Hand", "Toe Shoulder",
        "Pelvis L5 L3 T12 T8 Neck Head",
    ),
    "Biped": (
        "Biped", "Bip01 {c} {w}", "Thigh Calf Foot UpperArm Forearm Hand",
        "Toe0 Clavicle Finger0 Finger1",
        "Bip01 Bip01_Footsteps Bip01_Pelvis Bip01_Spine Bip01_Neck Bip01_Head",
    ),
    "Biped 001": (
        "Biped", "Bip001_{c}_{w}", "Thigh Calf Foot UpperArm Forearm Hand", "Toe0",
        "Bip001 Bip001_Pelvis Bip001_Head",
    ),
    "Character Creator": (
        "Biped", "CC_Base_{c}_{w}", "Thigh Calf Foot Upperarm Forearm Hand",
        "ToeBase Clavicle", "CC_Base_Hip CC_Base_Pelvis CC_Base_Waist CC_Base_Head",
    ),
    "OpenSim bodies": (
        "OpenSim bodies", "{w}_{d}", "femur tibia talus humerus ulna hand",
        "calcn toes radius patella", "ground pelvis torso",
    ),
    "joint centres": (
        "joints by their names", "{c}{w}", "HJC KJC AJC SJC EJC WJC", "TOE HEE", "C7",
    ),
    "Plug-in Gait centres": (
        "Plug-in Gait joint centres", "{c}{w}", "FEP FEO TIO HUP HUO RAO",
        "FOO TOO HNO CLO", "PELO PELP TRXO HEDO",
    ),
    "SOMA": (
        "SOMA skeleton", "{b}{w}", "Leg Shin Foot Arm ForeArm Hand",
        "ToeBase Shoulder HandMiddle1", "Hips Spine1 Spine2 Chest Neck1 Head",
    ),
    "Theia": (
        "Theia segments", "{d}_{w}_4X4", "thigh shank foot uarm larm hand",
        "toes clavicle", "worldbody_4X4 pelvis_4X4 torso_4X4 neck_4X4 head_4X4",
    ),
    "Rokoko": (
        "Rokoko skeleton", "{a}{w}", "Thigh Shin Foot Arm ForeArm Hand",
        "Toe ToeTip Shoulder", "root hips spine1 spine2 neck head",
    ),
    "MediaPipe": (
        "MediaPipe landmarks", "{a}_{w}", "hip knee ankle shoulder elbow wrist",
        "heel foot_index pinky index thumb eye_inner eye ear", "nose mouth_left",
    ),
    "FreeMoCap": (
        "MediaPipe landmarks", "body_{a}_{w}", "hip knee ankle shoulder elbow wrist",
        "heel foot_index pinky index thumb", "body_nose body_hips_center",
    ),
    "OpenPose, OpenCap": (
        "joints by their names", "{c}{w}", "Hip Knee Ankle Shoulder Elbow Wrist",
        "BigToe SmallToe Heel _ankle_study _mankle_study _knee_study", "Neck midHip",
    ),
    "Mixamo": (
        "Mixamo-like skeleton", "mixamorig:{b}{w}",
        "UpLeg Leg Foot Arm ForeArm Hand", "ToeBase Shoulder HandMiddle1",
        "mixamorig:Hips mixamorig:Spine mixamorig:Neck mixamorig:Head",
    ),
    "Mixamo without a colon": (
        "Mixamo-like skeleton", "mixamorig4{b}{w}",
        "UpLeg Leg Foot Arm ForeArm Hand", "ToeBase Shoulder",
        "mixamorig4Hips mixamorig4Spine mixamorig4Neck Armature",
    ),
    "Daz": (
        "joints by their names", "{d}{w}", "Thigh Shin Foot Shldr ForeArm Hand",
        "Toe Collar", "hip pelvis abdomen chest neck head",
    ),
    "MakeHuman": (
        "joints by their names", "{w}.{c}",
        "upperleg01 lowerleg01 foot upperarm01 lowerarm01 wrist",
        "upperleg02 lowerleg02 upperarm02 lowerarm02 toe1-1", "root spine05 neck01",
    ),
    "Unity, VRM": (
        "joints by their names", "{a}{w}",
        "UpperLeg LowerLeg Foot UpperArm LowerArm Hand", "Toes Shoulder",
        "hips spine chest upperChest neck head",
    ),
    "words apart": (
        "joints by their names", "{b} {w}", "Hip Knee Ankle Shoulder Elbow Wrist",
        "Toe", "Pelvis Head",
    ),
}  # fmt: skip


@pytest.mark.parametrize("tool", SKELETONS)
@pytest.mark.parametrize("person", ["", "Anna:", "S01_"])
def test_skeletons_of_many_tools_are_recognised(tool, person):
    called, form, words, more, middle = SKELETONS[tool]
    names = sided(words, form) + sided(more, form)
    names += [n for n in middle.split() if n not in names]
    found = recognise([person + n for n in names])
    assert found.name == called
    assert not found.on_skin
    for k, side in enumerate("LR"):
        for joint, word in zip(ORDER, words.split(), strict=True):
            wanted = sided(word, form)[k]
            got = [names[c] for c in found.columns[side + joint]]
            assert got == [wanted], side + joint


CMU = (
    "LFHD RFHD LBHD RBHD C7 T10 CLAV STRN LSHO LUPA LELB LFRM LWRA LWRB LFIN LTHMB "
    "LFWT LMWT LBWT LTHI LKNE LSHN LANK LHEE LTOE LMT5 LMT1 RSHO RUPA RELB RFRM RWRA "
    "RWRB RFIN RTHMB RFWT RMWT RBWT RTHI RKNE RSHN RANK RHEE RTOE RMT5 RMT1"
)
# Names, what the set is called, and the names of the left side's places.
MARKERS = {
    "CMU": (
        CMU, "CMU markers",
        "Asis=LFWT Psis=LBWT KneeOut=LKNE AnkleOut=LANK Toe=LTOE Acromion=LSHO "
        "ElbowOut=LELB Wrist=LWRA+LWRB HandBack=LFIN",
    ),
    "CMU, wrists in and out": (
        CMU.replace("WRA", "IWR").replace("WRB", "OWR"), "CMU markers",
        "Wrist=LIWR+LOWR Asis=LFWT",
    ),
    "Plug-in Gait, medial": (
        " ".join(sided("ASI PSI KNE KNEM ANK ANKM TOE HEE SHO ELB ELBM WRA WRB FIN",
                       "{c}{w}")) + " C7",
        "Plug-in Gait markers",
        "Asis=LASI Psis=LPSI KneeIn=LKNEM AnkleIn=LANKM ElbowIn=LELBM",
    ),
    "Plug-in Gait, small letters": (
        " ".join(sided("asi kne mkne ank mmed toe sho elb wra wrb", "{d}{w}"))
        + " sacr c7",
        "Plug-in Gait markers", "Psis=sacr KneeIn=lmkne AnkleIn=lmmed",
    ),
    "Plug-in Gait, one at the wrist": (
        " ".join(sided("ASIS PSIS KNE ANK TOE SHO ELB WRI", "{c}_{w}")),
        "markers by their names", "Asis=L_ASIS Wrist=L_WRI KneeOut=L_KNE",
    ),
    "OpenSim": (
        " ".join(sided("ASIS Thigh.Front Knee.Lat Knee.Med Ankle.Lat Ankle.Med Heel "
                       "Toe.Lat Toe.Med Toe.Tip Acromium Elbow.Lat Elbow.Med "
                       "Wrist.Radius Wrist.Ulna", "{c}.{w}"))
        + " V.Sacral Sternum Top.Head",
        "OpenSim markers",
        "Asis=L.ASIS Psis=V.Sacral KneeOut=L.Knee.Lat KneeIn=L.Knee.Med "
        "AnkleIn=L.Ankle.Med Acromion=L.Acromium Wrist=L.Wrist.Radius+L.Wrist.Ulna "
        "Toe=L.Toe.Med+L.Toe.Lat",
    ),
    "OpenCap, augmented": (
        " ".join(sided("ASIS_study PSIS_study", "{c}.{w}")
                 + sided("knee_study mknee_study ankle_study mankle_study toe_study "
                         "5meta_study calc_study shoulder_study lelbow_study "
                         "melbow_study lwrist_study mwrist_study thigh1_study",
                         "{c}_{w}")) + " C7_study",
        "OpenCap markers",
        "Asis=L.ASIS_study KneeOut=L_knee_study KneeIn=L_mknee_study "
        "Wrist=L_lwrist_study+L_mwrist_study Toe=L_toe_study Neck=C7_study",
    ),
    "OpenSim, Rajagopal": (
        " ".join(sided("ACR ASI PSI LFC MFC LMAL MMAL CAL TOE MT5 LEL MEL FAradius "
                       "FAulna HJC KJC AJC SJC EJC", "{c}{w}")) + " C7 CLAV",
        "markers by their names",
        "KneeOut=LLFC KneeIn=LMFC AnkleOut=LLMAL AnkleIn=LMMAL ElbowOut=LLEL "
        "ElbowIn=LMEL Wrist=LFAradius+LFAulna Acromion=LACR",
    ),
    "Human Body Model": (
        " ".join(sided("ASIS PSIS GTRO LEK MEK LM MM TOE HEE MT5 SHO LEE MEE LW MW FIN",
                       "{c}{w}")) + " T10 C7 SACR XYPH NAVE",
        "markers by their names",
        "KneeOut=LLEK KneeIn=LMEK AnkleOut=LLM AnkleIn=LMM ElbowOut=LLEE "
        "Wrist=LLW+LMW HandBack=LFIN",
    ),
    "ISB": (
        " ".join(sided("IAS IPS FTC FLE FME FAL TAM FCC FM1 FM2 FM5 SAE HLE HME RSP "
                       "USP HM2 HM5", "{c}_{w}")) + " CV7 TV10 SJN",
        "markers by their names",
        "Asis=L_IAS KneeOut=L_FLE KneeIn=L_FME AnkleOut=L_FAL AnkleIn=L_TAM "
        "Toe=L_FM2 Acromion=L_SAE Wrist=L_RSP+L_USP HandBack=L_HM2+L_HM5 Neck=CV7",
    ),
    "Qualisys": (
        " ".join(sided("ShoulderTop ShoulderBack Arm ElbowOut WristOut WristIn HandOut "
                       "HandIn Thigh KneeOut Shin AnkleOut HeelBack ForefootOut ToeTip "
                       "ForefootIn", "{c}{w}"))
        + " HeadL HeadTop HeadR HeadFront Chest SpineTop BackL BackR WaistLFront "
          "WaistLBack WaistRFront WaistRBack",
        "Qualisys markers",
        "Asis=WaistLFront Psis=WaistLBack Toe=LForefootIn+LForefootOut "
        "HandBack=LHandIn+LHandOut Neck=SpineTop",
    ),
    "Qualisys, clinical": (
        " ".join(sided("FrontShoulder BackShoulder LatElbow MedElbow LatWrist MedWrist "
                       "Hand IC PSIS ASIS GT LFC MFC LTP MTP LMA MMA PHE 1ST 2ND 5TH "
                       "TOE", "{c}{w}")),
        "markers by their names",
        "Acromion=LFrontShoulder+LBackShoulder ElbowIn=LMedElbow KneeOut=LLFC "
        "AnkleOut=LLMA AnkleIn=LMMA Wrist=LLatWrist+LMedWrist HandBack=LHand",
    ),
}  # fmt: skip


@pytest.mark.parametrize("tool", MARKERS)
@pytest.mark.parametrize("person", ["", "Anna:", "S01_"])
def test_marker_sets_of_many_tools_are_recognised(tool, person):
    text, called, places = MARKERS[tool]
    names = text.split()
    found = recognise([person + n for n in names])
    assert found.on_skin
    assert found.name == called
    for side, other in (("L", None), ("R", "R")):
        for entry in places.split():
            place, _, wanted = entry.partition("=")
            key = place if place == "Neck" else side + place
            got = {names[c] for c in found.columns[key]}
            expected = set(wanted.split("+"))
            if other:
                expected = {mirrored(n, names) for n in expected}
            assert got == expected, key


def mirrored(name: str, names: list[str]) -> str:
    """The name of the right side: one L or l is an R or r; the same where none is."""
    for k, c in enumerate(name):
        if c in "Ll":
            other = name[:k] + ("R" if c == "L" else "r") + name[k + 1 :]
            if other in names:
                return other
    return name


def test_of_two_people_with_any_separator_one_must_be_named():
    names = [f"{p} {n}" for p in ("P1", "P2") for n in CMU.split()]
    with pytest.raises(InputError, match=r"subject.*'P1', 'P2'"):
        recognise(names)
    second = recognise(names, subject="P2")
    assert names[second.columns["LKneeOut"][0]] == "P2 LKNE"


def test_a_refusal_says_what_is_missing_and_what_is_left_over():
    names = sided("thigh calf foot upperarm lowerarm hand", "{w}_{d}")
    names[names.index("calf_l")] = "blob"
    with pytest.raises(InputError) as e:
        recognise(names, source="take.npz")
    assert str(e.value) == (
        "take.npz: names: expected a joint or markers for LKnee: name them under "
        "`parts` of a recording.yaml; left over are blob"
    )
    with pytest.raises(InputError, match=r"for RElbowOut: .* left over are .*RXXX"):
        recognise(CMU.replace("RELB", "RXXX").split())


def test_parts_may_name_places_of_a_marker_set():
    names = CMU.replace("RELB", "RXXX").replace("LKNE", "UP").split()
    parts = {"RElbowOut": "RXXX", "LKneeOut": ["UP", "LSHN"]}
    found = recognise(names, parts=parts)
    assert found.on_skin
    assert [names[c] for c in found.columns["LKneeOut"]] == ["UP", "LSHN"]
    track = {i: np.full((2, 3), float(i)) + np.eye(3)[:2] * i for i in found.used()}
    points = solve_centres(found, track)
    np.testing.assert_array_equal(points["RElbow"], track[names.index("RXXX")])
    assert not {"LKneeOut", "RElbowOut"} & points.keys()


def test_places_are_named_in_a_file(tmp_path):
    names = CMU.replace("RELB", "RXXX").split()
    rng = np.random.default_rng(0)
    np.savez(tmp_path / "a.npz", positions=rng.normal(size=(9, len(names), 3)),
             names=names, rate=60.0)  # fmt: skip
    said = {"file": "a.npz", "unit": "m", "parts": {"RElbowOut": "RXXX"}}
    (tmp_path / "r.yaml").write_text(yaml.safe_dump(said))
    assert "CMU markers and `parts`" in load_demo(tmp_path / "r.yaml").notes[0]
