"""The Python side of the simulation comparison: control steps a second, with two camera images each.

    python env_step.py mujoco SCENE.xml CAMERA CAMERA [--px 128] [--steps 300]   # needs mujoco==3.17.0
    python env_step.py robosuite NutAssemblySquare [--px 128] [--steps 100]      # needs robosuite

mujoco: 25 physics steps of 2 ms a control step, then both cameras through mujoco.Renderer (MUJOCO_GL=egl or osmesa). No inverse
kinematics, no observation: less than our control step does.
robosuite: Panda, OSC_POSE at 20 Hz, the same two images.
"""

import argparse
import json
import os
import time

os.environ.setdefault("MUJOCO_GL", "egl")

parser = argparse.ArgumentParser()
parser.add_argument("kind", choices=["mujoco", "robosuite"])
parser.add_argument("what")
parser.add_argument("cameras", nargs="*")
parser.add_argument("--px", type=int, default=128)
parser.add_argument("--steps", type=int, default=200)
args = parser.parse_args()

if args.kind == "mujoco":
    import mujoco

    model = mujoco.MjModel.from_xml_path(args.what)
    data = mujoco.MjData(model)
    renderer = mujoco.Renderer(model, args.px, args.px)
    mujoco.mj_forward(model, data)

    def step():
        mujoco.mj_step(model, data, 25)
        for camera in args.cameras:
            renderer.update_scene(data, camera)
            renderer.render()

else:
    import numpy as np
    import robosuite

    env = robosuite.make(
        args.what,
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=True,
        use_camera_obs=True,
        use_object_obs=True,
        control_freq=20,
        camera_names=["agentview", "robot0_eye_in_hand"],
        camera_heights=args.px,
        camera_widths=args.px,
        horizon=10**6,
    )
    env.reset()
    still = np.zeros(env.action_dim)

    def step():
        env.step(still)


for _ in range(5):
    step()
start = time.perf_counter()
for _ in range(args.steps):
    step()
rate = args.steps / (time.perf_counter() - start)
line = {"peer": args.kind, "what": os.path.basename(args.what), "px": args.px, "gl": os.environ["MUJOCO_GL"]}
print(json.dumps(line | {"control_steps_per_s": round(rate, 1)}))
