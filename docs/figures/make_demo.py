"""The animation of the README: detections of three cameras beside the tracks that `stereophd demo` finds in them.

stereophd demo out && python docs/figures/make_demo.py out docs/figures/demo.gif
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pyarrow.parquet as pq
from matplotlib.animation import FuncAnimation, PillowWriter

import stereophd

FRAMES_PER_S = 10
START_S, END_S = 1.0, 7.0
# How long a detection and a trail stay in the picture, s.
SHOWN_S, TRAIL_S = 0.1, 2.0
COLOURS = plt.get_cmap("tab10").colors


def main(folder: Path, target: Path) -> None:
    """Draw the animation of a demonstration."""
    cameras = stereophd.read_cameras(folder / "simulated" / "cameras.yaml")
    log = pq.read_table(folder / "simulated" / "detections.parquet").to_pydict()
    log = {name: np.array(log[name]) for name in ("time_s", "camera", "u_px", "v_px")}
    tracks = pq.read_table(folder / "tracked" / "tracks.parquet").to_pydict()
    tracks = {name: np.array(tracks[name]) for name in ("time_s", "track_id", "x", "y", "z", "status")}

    inside = (tracks["time_s"] >= START_S) & (tracks["time_s"] <= END_S) & (tracks["status"] == "confirmed")
    centers = np.array([camera.pose.center for camera in cameras])
    signed = {"x": tracks["x"][inside], "y": -tracks["y"][inside], "z": tracks["z"][inside]}
    limits = {
        axis: (min(values.min(), own.min()) - 0.3, max(values.max(), own.max()) + 0.3)
        for (axis, values), own in zip(signed.items(), (centers * [1, -1, 1]).T, strict=True)
    }
    figure = plt.figure(figsize=(8.6, 4.2), dpi=80)
    grid = figure.add_gridspec(len(cameras), 1, left=0.03, right=0.27, top=0.9, bottom=0.02, hspace=0.06)
    images = []
    for row, camera in enumerate(cameras):
        axes = figure.add_subplot(grid[row], facecolor="black")
        axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), xticks=[], yticks=[])
        axes.set_ylabel(camera.name, fontsize=8)
        axes.set_aspect("equal")
        images.append(axes.scatter([], [], s=9, c="white"))
    scene = figure.add_axes((0.28, 0.02, 0.7, 0.94), projection="3d")
    figure.text(0.02, 0.94, "you have: unlabelled detections, some false", fontsize=10, weight="bold")
    figure.text(0.72, 0.94, "you get: tracks in 3-D", fontsize=10, weight="bold")

    def draw(number: int) -> None:
        time = START_S + number / FRAMES_PER_S
        for camera, image in zip(cameras, images, strict=True):
            chosen = (log["camera"] == camera.name) & (np.abs(log["time_s"] - time) <= SHOWN_S / 2)
            image.set_offsets(np.column_stack([log["u_px"][chosen], log["v_px"][chosen]]).astype(float))
        scene.clear()
        scene.set(xlim=limits["x"], ylim=limits["z"], zlim=limits["y"], xlabel="x, m", ylabel="depth, m")
        scene.set_zlabel("height, m")
        scene.view_init(30, -50)
        scene.set_box_aspect((5, 8, 3), zoom=1.02)
        for camera in cameras:
            x, y, z = camera.pose.center
            scene.scatter([x], [z], [-y], marker="s", c="black", s=18)
            scene.text(x, z, -y + 0.5, camera.name, fontsize=8)
        shown = (tracks["time_s"] <= time) & (tracks["time_s"] > time - TRAIL_S) & (tracks["status"] == "confirmed")
        for track in np.unique(tracks["track_id"][shown]):
            rows = shown & (tracks["track_id"] == track)
            x, y, z = (tracks[axis][rows] for axis in "xyz")
            colour = COLOURS[int(track) % len(COLOURS)]
            scene.plot(x, z, -y, color=colour, linewidth=2.5)
            scene.scatter(x[-1:], z[-1:], -y[-1:], color=[colour], s=36)

    animation = FuncAnimation(figure, draw, frames=round((END_S - START_S) * FRAMES_PER_S))
    animation.save(target, writer=PillowWriter(fps=FRAMES_PER_S))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
