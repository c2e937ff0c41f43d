"""Two small humanoids, written here: an MJCF and a URDF, with names that say nothing.

Lengths in metres for `scale` 1: thigh 0.26, shank 0.25, ankle 0.06 above the sole. The
MJCF has three hinges on one body at its hips, as many models do, and faces along y; the
URDF has one link for each joint, a fixed root, fixed sensors and coupled fingers.
"""

from __future__ import annotations

from pathlib import Path

THIGH, SHANK, ANKLE = 0.26, 0.25, 0.06
UPPER, FORE = 0.20, 0.20
MASS = 30.0  # [kg] about


def mjcf(scale: float = 1.0, *, effort: bool = True) -> str:
    """A humanoid with 21 hinges, capsules and boxes, that faces along y."""
    s = scale
    weight = s**3

    def joint(name: str, axis: str, low: float, high: float, torque: float) -> str:
        limit = f'actuatorfrcrange="{-torque * s**4} {torque * s**4}"' if effort else ""
        return f'<joint name="{name}" axis="{axis}" range="{low} {high}" {limit}/>'

    def capsule(a: str, b: str, r: float, mass: float) -> str:
        ends = " ".join(str(s * float(x)) for x in f"{a} {b}".split())
        return (
            f'<geom type="capsule" fromto="{ends}" size="{r * s}"'
            f' mass="{mass * weight}"/>'
        )

    def leg(tag: str, x: float, out: int) -> str:
        # Facing along y, the left side is at negative x and the lateral axis is -x.
        roll = (-0.4, 0.8) if out > 0 else (-0.8, 0.4)
        return f"""
        <body name="{tag}1" pos="{x * s} 0 0">
          {joint(tag + "a", "0 0 1", -0.8, 0.8, 80)}
          {joint(tag + "b", "0 1 0", *roll, 80)}
          {joint(tag + "c", "1 0 0", -0.8, 1.9, 80)}
          {capsule("0 0 -0.06", f"0 0 {0.05 - THIGH}", 0.05, 3.0)}
          <body name="{tag}2" pos="0 0 {-THIGH * s}">
            {joint(tag + "d", "1 0 0", -2.3, 0.0, 80)}
            {capsule("0 0 -0.02", f"0 0 {0.04 - SHANK}", 0.042, 2.0)}
            <body name="{tag}3" pos="0 0 {-SHANK * s}">
              {joint(tag + "e", "1 0 0", -0.9, 0.9, 60)}
              {joint(tag + "f", "0 1 0", -0.5, 0.5, 60)}
              <geom type="box" size="{0.04 * s} {0.085 * s} {0.01 * s}"
                pos="0 {0.03 * s} {(0.01 - ANKLE) * s}" mass="{0.7 * weight}"/>
            </body>
          </body>
        </body>"""

    def arm(tag: str, x: float, out: int) -> str:
        roll = (-0.3, 2.2) if out > 0 else (-2.2, 0.3)
        return f"""
        <body name="{tag}1" pos="{x * s} 0 {0.2 * s}">
          {joint(tag + "a", "1 0 0", -1.6, 3.2, 50)}
          {joint(tag + "b", "0 1 0", *roll, 50)}
          {joint(tag + "c", "0 0 1", -1.6, 1.6, 50)}
          {capsule("0 0 -0.02", f"0 0 {0.03 - UPPER}", 0.038, 1.6)}
          <body name="{tag}2" pos="0 0 {-UPPER * s}">
            {joint(tag + "d", "1 0 0", 0.0, 2.4, 50)}
            {capsule("0 0 -0.01", f"0 0 {-FORE}", 0.03, 1.2)}
          </body>
        </body>"""

    return f"""
<mujoco model="small">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="b0" pos="0 0 {(THIGH + SHANK + ANKLE) * s}">
      <freejoint/>
      {capsule("-0.05 0 0.03", "0.05 0 0.03", 0.06, 4.0)}
      <body name="b1" pos="0 0 {0.12 * s}">
        {joint("ba", "0 0 1", -1.2, 1.2, 80)}
        {joint("bb", "1 0 0", -0.9, 0.4, 80)}
        {joint("bc", "0 1 0", -0.5, 0.5, 80)}
        {capsule("-0.05 0 0.12", "0.05 0 0.12", 0.075, 8.0)}
        <body name="h" pos="0 0 {0.26 * s}">
          <joint name="ha" axis="0 0 1" range="-1 1"/>
          <geom type="sphere" size="{0.05 * s}" pos="0 0 {0.06 * s}" mass="{weight}"/>
        </body>
        {arm("v", -0.17, 1)}
        {arm("w", 0.17, -1)}
      </body>
      {leg("t", -0.08, 1)}
      {leg("u", 0.08, -1)}
    </body>
  </worldbody>
</mujoco>"""


def urdf(*, mimic_knee: bool = False, mesh: str = "") -> str:
    """A humanoid with 22 hinges in limbs and trunk, faces along x, root fixed.

    Args:
        mimic_knee: One knee follows the other.
        mesh: File name of a mesh that the torso is drawn with.
    """
    text = (Path(__file__).parent / "data" / "small.urdf").read_text().rstrip()
    if mimic_knee:
        start = text.index("</joint>", text.index('<joint name="q3j"'))
        text = text[:start] + '<mimic joint="p3j"/>' + text[start:]
    if mesh:
        drawn = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
        start = text.index("</link>", text.index('<link name="k2"'))
        text = text[:start] + drawn + text[start:]
    return text
