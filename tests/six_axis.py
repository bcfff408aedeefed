"""Another robot: six arm axes, a palm and three fingers of boxes, of three joints each."""

from pathlib import Path

_FINGERS = {
    "thumb": ((-0.045, 0.0), 0),
    "left": ((0.045, 0.03), 180),
    "right": ((0.045, -0.03), 180),
}
_MASS = '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
_JOINT = '<joint name="{}" axis="{}" range="{} {}" armature="0.1"/>'


def _finger(name: str) -> str:
    (x, y), yaw = _FINGERS[name]
    bend = "0 1 0"
    return f"""
      <body name="{name}_root" pos="{x} {y} 0.03" euler="0 0 {yaw}">
        {_JOINT.format(f"{name}_spread", "0 0 1", -0.4, 0.4)}
        <geom type="sphere" size="0.012"/>
        <body name="{name}_inner" pos="0 0 0.015">
          {_JOINT.format(f"{name}_inner", bend, -1.2, 1.2)}
          <geom type="box" size="0.009 0.009 0.025" pos="0 0 0.03"/>
          <body name="{name}_outer" pos="0 0 0.06">
            {_JOINT.format(f"{name}_outer", bend, -0.6, 1.5)}
            <geom name="{name}_end" type="capsule" fromto="0 0 0.005 0 0 0.045" size="0.009"/>
            <site name="{name}_tip" pos="0 0 0.045"/>
            <site name="{name}_pad" pos="0.009 0 0.045"/>
          </body>
        </body>
      </body>"""


_ARM = ("turn", "shoulder", "elbow", "forearm", "wrist", "flange")
_HAND = tuple(f"{f}_{j}" for f in _FINGERS for j in ("spread", "inner", "outer"))

MJCF = f"""<mujoco model="six_axis">
  <compiler angle="radian" autolimits="true" eulerseq="xyz"/>
  <worldbody>
    <body name="column">
      <geom type="cylinder" size="0.06 0.06" pos="0 0 0.06"/>
      <body name="turntable" pos="0 0 0.16">
        {_MASS}
        {_JOINT.format("turn", "0 0 1", -2.9, 2.9)}
        <geom type="sphere" size="0.06"/>
        <body name="upper">
          {_MASS}
          {_JOINT.format("shoulder", "0 1 0", -1.8, 1.8)}
          <geom type="capsule" fromto="0 0 0.05 0 0 0.42" size="0.05"/>
          <body name="lower" pos="0 0 0.45">
            {_JOINT.format("elbow", "0 1 0", -2.6, 2.6)}
            <geom type="capsule" fromto="0 0 0.02 0 0 0.2" size="0.045"/>
            <body name="roll" pos="0 0 0.2">
              {_JOINT.format("forearm", "0 0 1", -2.9, 2.9)}
              <geom type="capsule" fromto="0 0 0 0 0 0.18" size="0.04"/>
              <body name="pitch" pos="0 0 0.2">
                {_JOINT.format("wrist", "0 1 0", -2.2, 2.2)}
                <geom type="box" size="0.035 0.035 0.035" pos="0 0 0.03"/>
                <body name="end" pos="0 0 0.1">
                  {_JOINT.format("flange", "0 0 1", -3.0, 3.0)}
                  <body name="palm" pos="0 0 0.03">
                    {_MASS}
                    <geom type="box" size="0.055 0.05 0.02"/>
                    <site name="palm_centre"/>
                    {"".join(map(_finger, _FINGERS))}
                  </body>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    {"".join(f'<position name="{name}" joint="{name}" kp="50"/>' for name in (*_ARM, *_HAND))}
  </actuator>
</mujoco>
"""


def _finger_entry(name: str) -> str:
    joints = ", ".join(f"{name}_{joint}" for joint in ("spread", "inner", "outer"))
    return f"""
  - name: {name}
    role: {"thumb" if name == "thumb" else "wrap"}
    joints: [{joints}]
    policy_joints: [{joints}]
    bodies: [{name}_root, {name}_inner, {name}_outer]
    tip_body: {name}_outer
    tip_geom: {name}_end
    tip_site: {name}_tip
    pad_site: {name}_pad"""


DESCRIPTION = f"""name: six_axis
mjcf: six_axis.xml
arm:
  name: six axes
  joints: [{", ".join(_ARM)}]
  policy_joints: [{", ".join(_ARM)}]
  home: [0.0, -0.1, 1.9, 0.0, 1.34, 0.0]
  velocity_limits: [1.0, 1.0, 1.0, 1.5, 1.5, 1.5]
hand:
  name: three fingers of boxes
  palm_body: palm
  palm_site: palm_centre
  approach_axis: [0, 0, 1]
  opposing_axis: [1, 0, 0]
  span: [0.02, 0.09]
  scoring_friction: 0.5
  velocity_limit: 3.0
  joints: [{", ".join(_HAND)}]
  open_posture: [{", ".join(["0.0, -0.5, 0.2"] * len(_FINGERS))}]
  fingers:{"".join(map(_finger_entry, _FINGERS))}
"""


def write_six_axis(folder: Path) -> Path:
    """Writes MJCF and description; returns the description."""
    (folder / "six_axis.xml").write_text(MJCF)
    path = folder / "six_axis.yaml"
    path.write_text(DESCRIPTION)
    return path
