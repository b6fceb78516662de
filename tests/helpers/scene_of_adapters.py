"""The scene of the adapters' tests: a cube on a palm, below a pad that turns."""

PAD = '<geom type="box" size=".03 .02 .015" pos="0 0 .02" mass=".1"/>'
PALM = '<geom type="box" size=".05 .05 .01" friction="1"/>'
BOX = '<geom type="box" size=".02 .02 .02" pos="0 0 .001" mass=".25" friction="1"/>'
PALM_AND_PAD = f"""
<body name="palm" euler="4 0 0">{PALM}
  <body name="pad" pos="0 0 .08"><joint name="bend" axis="0 1 0" damping=".01"/>{PAD}</body>
</body>
"""
CUBE = f'<body name="cube" pos="0 -.002 .0289" euler="4 0 0"><freejoint/>{BOX}</body>'
SCENE = f'<mujoco model="hand"><option timestep=".002"/><worldbody>{PALM_AND_PAD}{CUBE}</worldbody></mujoco>'

FREE = f"""
<mujoco><option timestep=".002"/><worldbody>
  <body name="palm"><freejoint/>{PALM}</body><body name="pad"><freejoint/>{PAD}</body><body name="cube"><freejoint/>{BOX}</body>
</worldbody></mujoco>
"""
"""The same bodies without joints: MuJoCo is put where another engine's bodies are."""
LOAD = {"kind": "link_contact", "links": ["palm"], "feels": ["cube"], "outputs": ["force"]}
DEPTH = {"kind": "contact_depth", "links": ["palm"], "feels": ["cube"]}


def document(folder, scene=SCENE, **sensors) -> dict:
    (folder / "scene.xml").write_text(scene)
    probes = [{"pos": [x, y, 0.01], "normal": [0, 0, 1]} for x in (-0.01, 0.01) for y in (-0.01, 0.01)]
    points = {"method": "points", "points": probes, "radius": 0.005}
    skin = {"kind": "kinematic_taxel", "links": ["palm", "pad"], "feels": ["cube"], "normal_stiffness": 500}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"only": {"palm": points, "pad": points}}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"skin": skin, **sensors},
        "observations": {"policy": [{"type": "force", "of": "skin"}]},
    }
