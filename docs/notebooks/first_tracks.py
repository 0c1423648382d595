# %% [markdown]
# # From a data frame to tracks
#
# Detections of three cameras that are not synchronised become 3-D tracks in a data frame. Put your own two files in
# place of the demo's: a table of detections, and `cameras.yaml`.

# %%
import pandas as pd

import stereophd

demo = stereophd.demo("demo", force=True)
detections = pd.read_parquet("demo/simulated/detections.parquet")
detections.head(3)

# %% [markdown]
# A row is one detection, and a row without a pixel is a frame without detections. `track` estimates the settings from
# the detections if it is given none.

# %%
run = stereophd.track(detections, cameras="demo/simulated/cameras.yaml", smooth=True, associations=True)
run

# %%
tracks = run.to_pandas()
tracks.groupby("track_id").agg(first_s=("time_s", "min"), last_s=("time_s", "max"), height=("y", "mean")).round(2)

# %%
run.plot("top")

# %% [markdown]
# The residuals show whether the cameras fit: they scatter about zero, without drift.

# %%
run.plot("residuals")

# %% [markdown]
# Every estimate has a covariance of position and velocity in the world frame. Its first three diagonal elements are the
# variances of the position:

# %%
(run.covariances[:, range(3), range(3)].mean(axis=0) ** 0.5).round(4)

# %% [markdown]
# The demo knows the truth. `evaluate` scores the tracks against it.

# %%
stereophd.evaluate(run, "demo/simulated/truth.parquet", cutoff=1.0)

# %% [markdown]
# `stereophd.report_page(run)` shows tracks and cameras in three dimensions, inside the notebook.
