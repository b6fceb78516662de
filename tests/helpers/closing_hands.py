"""Hands without keyframes, for runs that close them by themselves."""

GRIPPER = """
<mujoco>
  <default><joint type="slide" axis="0 1 0" range="0 .04" damping="20"/></default>
  <worldbody>
    <body name="arm" pos="0 0 .5"><joint name="lift" axis="0 0 1" range="-.2 .2" type="slide" damping="1"/>
      <geom type="box" size=".03 .03 .05" pos="0 0 .1" mass="2"/>
      <body name="elbow" pos="0 0 .05"><joint name="turn" type="hinge" axis="1 0 0" range="-2 2"/><geom size=".02" mass="1"/>
        <body name="hand" pos="0 0 -.05"><geom type="box" size=".02 .06 .02" mass=".5"/>
          <body name="left" pos="0 0 -.03"><joint name="left slide"/>
            <geom type="box" size=".01 .005 .02" pos="0 .005 -.02" mass=".02"/></body>
          <body name="right" pos="0 0 -.03" euler="0 0 180"><joint name="right slide"/>
            <geom type="box" size=".01 .005 .02" pos="0 .005 -.02" mass=".02"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="right slide" joint2="left slide"/></equality>
  <actuator><position name="grip" joint="left slide" kp="200" ctrlrange="0 .04"/><motor name="up" joint="lift"/></actuator>
</mujoco>
"""
"""A parallel gripper on an arm that its motors do not hold up; closed at the start; one jaw follows the other."""
_INERTIAL = "<inertial><mass value='.03'/><inertia ixx='1e-5' iyy='1e-5' izz='1e-5' ixy='0' ixz='0' iyz='0'/></inertial>"


def _link(name: str, geometry: str, xyz: str) -> str:
    return f"<link name='{name}'>{_INERTIAL}<collision><origin xyz='{xyz}'/><geometry>{geometry}</geometry></collision></link>"


def _joint(name: str, parent: str, child: str, xyz: str, axis: str, mimic: str = "") -> str:
    limit = "<limit lower='0' upper='1.6' effort='1' velocity='1'/>"
    ends = f"<parent link='{parent}'/><child link='{child}'/><origin xyz='{xyz}'/><axis xyz='{axis}'/>"
    return f"<joint name='{name}' type='revolute'>{ends}{limit}{mimic}</joint>"


def _finger(name: str, xyz: str, axis: str) -> str:
    bone = "<box size='.012 .012 .036'/>"
    links = _link(f"{name} low", bone, "0 0 .02") + _link(f"{name} tip", bone, "0 0 .02")
    joints = _joint(f"{name}_1", "palm", f"{name} low", xyz, axis)
    mimic = f"<mimic joint='{name}_1' multiplier='.8'/>"
    return links + joints + _joint(f"{name}_2", f"{name} low", f"{name} tip", "0 0 .04", axis, mimic)


URDF = f"""<robot name='three fingers'>{_link("palm", "<box size='.08 .08 .02'/>", "0 0 0")}
{_finger("a", ".035 .02 .01", "0 -1 0")}{_finger("b", ".035 -.02 .01", "0 -1 0")}{_finger("thumb", "-.035 0 .01", "0 1 0")}</robot>"""
"""Three fingers of two links, without actuators; each second joint follows the first."""
