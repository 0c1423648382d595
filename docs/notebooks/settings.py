# %% [markdown]
# # Comparing settings
#
# Which acceleration should a filter allow? Simulated scenes of your own set-up tell it before you record: their truth
# is known.

# %%
import pandas as pd

import stereophd

stereophd.demo("demo", force=True)
config = "demo/config.yaml"
scenes = [stereophd.simulate(config, seed=seed, overrides=["simulate.duration_s=8"]) for seed in (1, 2)]
[scene.report["detections"] for scene in scenes]

# %% [markdown]
# Each scene is tracked with each setting, and scored.

# %%
rows = []
for number, scene in enumerate(scenes):
    for acceleration in (0.01, 0.1, 1.0):
        run = stereophd.track(scene, config, scene, overrides=[f"motion.acceleration_std={acceleration}"])
        scores = stereophd.evaluate(run, scene, cutoff=1.0).report
        rows.append((number, acceleration, scores["ospa"]["mean"], scores["nees"]["position"]))
table = pd.DataFrame(rows, columns=["scene", "acceleration_std", "ospa", "nees"])
table.groupby("acceleration_std")[["ospa", "nees"]].mean().round(3)

# %% [markdown]
# The simulated objects accelerate by 0.1 m/s². OSPA (in m) is an error, the smaller the better. NEES compares errors
# with the covariances that the filter gives: 3 would be perfect for three coordinates, much more is overconfident. A
# value that is too small loses objects that turn; one that is too large only makes the estimates noisier.
