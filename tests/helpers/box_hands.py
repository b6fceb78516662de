"""A hand of boxes: a palm and two fingers of two links, with gaps between, so that areas of sides are products of edges."""

_FINGER = """
    <body name="{0}" pos="{1} 0 .014"><joint axis="0 {2} 0" range="0 90"/><geom type="box" size=".005 .008 .014" pos="0 0 .015"/>
      <body name="{0}_tip" pos="0 0 .032"><joint axis="0 {2} 0" range="0 90"/><geom type="box" size=".005 .008 .015" pos="0 0 .016"/></body>
    </body>"""
BOX_HAND = f"""<mujoco><worldbody><body name="palm"><geom type="box" size=".04 .03 .01"/>{_FINGER.format("left", -0.03, 1)}
{_FINGER.format("right", 0.03, -1)}
</body></worldbody></mujoco>"""
TIP_AREA = 16.0 * 30.0  # of the side of a tip that faces the other finger [mm²]
