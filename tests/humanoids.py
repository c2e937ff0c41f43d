"""Two small humanoids, written here: an MJCF and a URDF, with names that say nothing.

Lengths in metres for `scale` 1: thigh 0.26, shank 0.25, ankle 0.06 above the sole. The
MJCF has three hinges on one body at its hips, as many models do, and faces along y; the
URDF has one link for each joint, a fixed root, fixed sensors and coupled fingers.
"""

from __future__ import annotations

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
    out: list[str] = []

    def link(name: str, mass: float, shapes: str = "") -> None:
        i = 0.4 * mass * 0.05**2
        out.append(
            f'<link name="{name}"><inertial><origin xyz="0 0 0"/><mass value="{mass}"/>'
            f'<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/>'
            f"</inertial>{shapes}</link>"
        )

    def cylinder(length: float, radius: float) -> str:
        return (
            f'<collision><origin xyz="0 0 {-length / 2}"/><geometry>'
            f'<cylinder length="{length}" radius="{radius}"/></geometry></collision>'
        )

    def hinge(
        name: str, parent: str, child: str, xyz: str, axis: str, limits: str, extra=""
    ) -> None:
        low, high, effort = limits.split()
        out.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>'
            f'<limit lower="{low}" upper="{high}" effort="{effort}" velocity="5"/>'
            f"{extra}</joint>"
        )

    drawn = (
        f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
        if mesh
        else ""
    )
    link(
        "k0", 5.0, '<collision><geometry><sphere radius="0.07"/></geometry></collision>'
    )
    trunk = '<origin xyz="0 0 0.14"/><geometry><box size="0.14 0.24 0.24"/></geometry>'
    link("k1", 0.5)
    hinge("j0", "k0", "k1", "0 0 0.1", "0 0 1", "-1.2 1.2 80")
    link("k2", 8.0, f"<collision>{trunk}</collision>{drawn}")
    hinge("j1", "k1", "k2", "0 0 0.02", "0 1 0", "-0.4 0.9 80")
    out.append(
        '<link name="eye"/><joint name="fix" type="fixed"><parent link="k2"/>'
        '<child link="eye"/><origin xyz="0.05 0 0.3"/></joint>'
    )
    foot = (
        '<collision><origin xyz="0.03 0 -0.05"/>'
        '<geometry><box size="0.17 0.08 0.02"/></geometry></collision>'
    )
    for s, y in (("p", 1), ("q", -1)):
        roll = "-0.4 0.8" if y > 0 else "-0.8 0.4"
        names = [f"{s}{i}" for i in range(6)]
        for n, mass, shape in zip(
            names,
            (0.5, 0.5, 3.0, 2.0, 0.3, 0.7),
            ("", "", cylinder(0.2, 0.05), cylinder(0.22, 0.045), "", foot),
            strict=True,
        ):
            link(n, mass, shape)
        mimic = '<mimic joint="p3j"/>' if mimic_knee and s == "q" else ""
        hinge(f"{s}0j", "k0", names[0], f"0 {0.08 * y} 0", "0 0 1", "-0.8 0.8 80")
        hinge(f"{s}1j", names[0], names[1], "0 0 0", "1 0 0", f"{roll} 80")
        hinge(f"{s}2j", names[1], names[2], "0 0 0", "0 1 0", "-1.9 0.8 80")
        hinge(f"{s}3j", names[2], names[3], f"0 0 {-THIGH}", "0 1 0", "0 2.3 80", mimic)
        hinge(f"{s}4j", names[3], names[4], f"0 0 {-SHANK}", "0 1 0", "-0.9 0.9 60")
        hinge(f"{s}5j", names[4], names[5], "0 0 0", "1 0 0", "-0.5 0.5 60")
        arm = [f"{s}a{i}" for i in range(4)]
        for n, mass, shape in zip(
            arm,
            (0.5, 0.5, 1.5, 1.2),
            ("", "", cylinder(0.17, 0.038), cylinder(0.2, 0.03)),
            strict=True,
        ):
            link(n, mass, shape)
        roll = "-0.3 2.2" if y > 0 else "-2.2 0.3"
        hinge(f"{s}6j", "k2", arm[0], f"0 {0.18 * y} 0.2", "0 1 0", "-3.2 1.6 50")
        hinge(f"{s}7j", arm[0], arm[1], "0 0 0", "1 0 0", f"{roll} 50")
        hinge(f"{s}8j", arm[1], arm[2], "0 0 0", "0 0 1", "-1.6 1.6 50")
        hinge(f"{s}9j", arm[2], arm[3], f"0 0 {-UPPER}", "0 1 0", "-2.4 0 50")
        for f in (1, 2):
            link(f"{s}f{f}", 0.02)
            follow = f'<mimic joint="{s}g1"/>' if f == 2 else ""
            side = 0.01 * (2 * f - 3)
            hinge(
                f"{s}g{f}",
                arm[3],
                f"{s}f{f}",
                f"0 {side} {-FORE}",
                "1 0 0",
                "0 1 2",
                follow,
            )
    return '<robot name="small">' + "\n".join(out) + "</robot>"
