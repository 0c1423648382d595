"""Views, plots and the table of an evaluation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.metrics.scans import PointSets
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.report.plots.views import SceneView, field_of_view, limits, viewing_depth, views
from stereophd.report.scores import scores_text
from tests import scenes


def camera(rotation: np.ndarray, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    return scenes.build_camera("one", center, rotation, focal=400.0)


FORWARD_ALONG_Z = np.eye(3)
# Forward along world y, down along world -z: the world has z up.
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
# Forward along world x, right along world y, down along world z: north, east, down.
Z_DOWN = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


@pytest.mark.parametrize(
    ("rotation", "top", "side_vertical", "inverted"),
    [
        (FORWARD_ALONG_Z, SceneView(0, 2), 1, True),
        (Z_UP, SceneView(0, 1), 2, False),
        (Z_DOWN, SceneView(1, 0), 2, True),
        (np.diag([-1.0, -1, 1]), SceneView(2, 0), 1, False),
    ],
)
def test_views_follow_how_cameras_are_held(rotation, top, side_vertical, inverted):
    found = views([camera(rotation)], np.zeros((0, 3)))
    assert found["top"] == top
    assert (found["side"].vertical, found["side"].inverted) == (side_vertical, inverted)
    # Seen from above: right x up on the page points at the viewer, against the camera's downward axis.
    axes = np.eye(3)
    towards_viewer = np.cross(axes[top.horizontal], axes[top.vertical])
    assert towards_viewer @ rotation[1] == pytest.approx(-1)


def test_without_cameras_y_is_down_and_the_longer_axis_is_drawn():
    points = np.array([[0.0, 0, 0], [10, 1, 3]])
    assert views([], points) == {"top": SceneView(0, 2), "side": SceneView(0, 1, inverted=True)}
    assert views([], points[:, [2, 1, 0]])["side"].horizontal == 2


def test_limits_hold_all_points():
    points = np.array([[0.0, 0], [100, 1]])
    (left, right), (bottom, top) = limits(points)
    assert left < 0
    assert right > 100
    assert bottom < 0
    assert top > 1
    assert top - bottom >= (right - left) / 3
    low, high = limits(np.zeros((1, 2)))[0]
    assert low < 0 < high


def test_field_of_view_is_the_pyramid_of_the_image():
    one = camera(FORWARD_ALONG_Z)
    # 800 px at a focal length of 400 px: 90 degrees from above.
    outline = field_of_view(one, 10.0, SceneView(0, 2))
    assert sorted(map(tuple, outline.round(9))) == [(-10.0, 10.0), (0.0, 0.0), (10.0, 10.0)]
    assert viewing_depth(one, np.array([[0.0, 0, 4], [0, 0, 7], [0, 0, -9]])) > 2 * 7.0
    assert viewing_depth(one, np.zeros((0, 3))) == 0.0


def test_field_of_view_of_a_lens_that_reaches_the_middle_of_the_image_alone():
    one = replace(camera(FORWARD_ALONG_Z), lens=Lens("radial", k1=-10.0))
    outline = field_of_view(one, 10.0, SceneView(0, 2))
    assert np.ptp(outline[:, 0]) < 1e-9
    assert outline[:, 1].max() == pytest.approx(10.0)


def pictures(scans: int):
    pytest.importorskip("matplotlib")
    from stereophd.pipeline.evaluation.scoring import Scored
    from stereophd.report.plots.scene_plots import Pictures

    time = np.arange(scans, dtype=float)
    position = np.stack([time, np.sin(time), 100 + 0 * time], axis=1)
    columns = {"time_s": time, "ospa": 1 + np.sin(time) ** 2, "n_truth": np.ones(scans, dtype=int)}
    columns |= {"ospa_localisation": columns["ospa"], "ospa_cardinality": 0 * time}
    columns["n_estimates"] = columns["n_truth"] + (time % 7 == 0)
    truth = Truth(time, np.zeros(scans, dtype=np.int64), position)
    estimates = PointSets(np.arange(scans + 1), position, 0 * position, np.arange(scans) // 10)
    cameras = [camera(FORWARD_ALONG_Z)]
    report = {"length_unit": "cm", "max_gap_s": 1.5, "purity": {"table": []}, "completeness": {"table": []}}
    report["ospa"] = {"order": 2.0, "cutoff": 20.0, "base": "euclidean"}
    return Pictures(report, Scored({}, {}, columns, estimates), truth, cameras)


@pytest.mark.parametrize("scans", [1, 50, 4000])
def test_plots_are_made_for_short_and_long_runs(tmp_path, scans):
    data = pictures(scans)
    from stereophd.report.plots.scene_plots import write_plots

    names = [f"{plot}.{kind}" for plot in ("ospa", "cardinality", "top", "side") for kind in ("png", "svg")]
    write_plots(data, {name: tmp_path / name for name in names})
    for name in names:
        content = (tmp_path / name).read_bytes()
        assert content.startswith(b"\x89PNG" if name.endswith("png") else b"<?xml")
        assert len(content) < 2_000_000
        assert b"<dc:date>" not in content


def test_what_is_drawn():
    data = pictures(50)
    from stereophd.report.plots.scene_plots import draw_cardinality, draw_ospa, draw_views

    whole, parts = draw_ospa(data).axes
    assert whole.lines[0].get_ydata() == pytest.approx(data.scored.columns["ospa"])
    assert [line.get_label() for line in parts.lines] == ["cardinality part", "localisation part"]
    assert draw_cardinality(data).axes[0].lines[1].get_ydata() == pytest.approx(data.scored.columns["n_estimates"])
    top, side = draw_views(data)["top"].axes[0], draw_views(data)["side"].axes[0]
    assert (top.get_xlabel(), top.get_ylabel()) == ("x [cm]", "z [cm]")
    assert side.get_ylabel() == "y [cm] (down)"
    assert side.get_ylim()[0] > side.get_ylim()[1]
    assert top.get_aspect() == side.get_aspect() == 1.0
    drawn = next(line for line in top.lines if line.get_label() == "truth").get_xydata()
    assert drawn[~np.isnan(drawn[:, 0])] == pytest.approx(data.truth.position[:, [0, 2]])


def test_lines_break_where_nothing_was_scored():
    from dataclasses import replace

    from stereophd.report.plots.scene_plots import draw_ospa

    data = pictures(60)
    columns = {**data.scored.columns, "time_s": data.scored.columns["time_s"] + np.where(np.arange(60) < 20, 0, 100)}
    x, y = draw_ospa(replace(data, scored=replace(data.scored, columns=columns))).axes[0].lines[0].get_xydata().T
    assert np.flatnonzero(np.isnan(x)).tolist() == np.flatnonzero(np.isnan(y)).tolist() == [20]
    assert np.delete(y, 20) == pytest.approx(data.scored.columns["ospa"])


def test_long_runs_are_drawn_as_means_and_ranges():
    from stereophd.report.plots.scene_plots import MOST_SCANS_DRAWN, draw_ospa

    data = pictures(10 * MOST_SCANS_DRAWN)
    whole = draw_ospa(data).axes[0]
    assert len(whole.lines[0].get_xdata()) == MOST_SCANS_DRAWN
    assert whole.lines[0].get_ydata().mean() == pytest.approx(data.scored.columns["ospa"].mean())


def report(**changes) -> dict:
    values = {
        "length_unit": "cm",
        "ospa": {
            "mean": 1.25,
            "localisation": 1.0,
            "cardinality": 0.5,
            "order": 2.0,
            "cutoff": 20.0,
            "base": "euclidean",
        },
        "ospa2": {"mean": 3.125, "localisation": 2.0, "cardinality": 1.5, "window_scans": 10},
        "gospa": {"mean": 2.5, "alpha": 2.0},
        "rmse": {"position": 0.75, "velocity": None},
        "position_error": {"median": 0.5, "p90": 0.9, "n": 42},
        "cardinality": {"bias": -0.125, "mae": 0.25, "mean_truth": 6.0, "mean_estimates": 5.875},
        "pairs": {"matched": 42, "missed": 3, "false": 1},
        "identity_switches": 2,
        "clear_mot": {"mota": 0.87, "motp": 0.7, "mostly_tracked": 5, "mostly_lost": 1},
        "idf1": 0.93,
        "id_precision": 0.95,
        "id_recall": 0.91,
        "hota": {"mean": 0.81, "detection": 0.83, "association": 0.79, "localisation": 0.9},
        "tracks": 7,
        "purity": {"mean": 0.875, "table": []},
        "completeness": {"mean": 0.96, "mean_dominant": 0.91, "fragmentation": 1.17, "table": []},
        "nees": {"position": 3.5, "interval_95": [2.5, 3.6], "dimension": 3, "n": 42},
        "confirmation": {
            "mean_s": 1.5,
            "median_s": 1.25,
            "max_s": 4.0,
            "first_report_mean_s": 0.5,
            "objects": 6,
            "never": 1,
        },
        "alignment": {"frame": "none", "clock": False, "found": None},
        "tentative": False,
        "scans": {"scored": 8, "not_scored": 2, "outside_truth": 0, "truth_gap": 2, "unseen": 0},
        "window": {"from_s": 50.0, "to_s": None, "at": "times"},
        "seen_by": None,
        "plane": None,
    }
    return values | changes


def test_the_table_says_the_figures_with_units():
    text = scores_text(report())
    for expected in (
        "1.25 cm",
        "p 2, c 20 cm, euclidean",
        "0.75 cm",
        "42 matched pairs",
        "3 / 1",
        "from 50 s",
        "3.125 cm",
        "windows of 10 scans",
        "0.875",
        "0.96",
        "by one track 0.91",
        "1.17",
        "precision 0.95, recall 0.91",
        "detection 0.83, association 0.79",
        "1.5 s  mean over 6 objects; median 1.25 s, 1 never",
    ):
        assert expected in text
    assert "2 in a gap of the truth" in text
    assert "\x1b" not in text
    velocity = next(line for line in text.splitlines() if line.startswith("RMSE velocity"))
    assert velocity.split()[-1] == "-"


def test_the_table_of_a_run_without_identities_or_covariances():
    nees = {"position": None, "interval_95": [None, None], "dimension": 3, "n": 0}
    purity = {"mean": None, "table": []}
    completeness = {"mean": 0.5, "mean_dominant": None, "fragmentation": None, "table": []}
    changes = {"identity_switches": None, "purity": purity, "completeness": completeness, "nees": nees}
    changes |= dict.fromkeys(("idf1", "id_precision", "id_recall"))
    changes["clear_mot"] = {"mota": None, "mostly_tracked": None, "mostly_lost": None}
    changes["confirmation"] = {"mean_s": None, "median_s": None, "first_report_mean_s": None, "objects": 0, "never": 2}
    changes["hota"] = dict.fromkeys(("mean", "detection", "association", "localisation"))
    text = scores_text(report(**changes, length_unit=None, seen_by={"cameras": 2, "within_s": 0.2}))
    assert "no identities" in text
    assert "not defined" not in text
    assert "not defined on a plane" in scores_text(report(nees=nees, plane=[0.0, 0.0, 1.0]))
    assert "seen by 2 cameras within 0.2 s" in text
    assert " cm" not in text


def test_spikes_do_not_hide_the_rest():
    from dataclasses import replace

    from stereophd.report.plots.scene_plots import draw_ospa

    data = pictures(60)
    flat = np.full(60, 0.2)
    for ospa, scale in ((flat, "linear"), (np.where(np.arange(60) == 7, 20.0, flat), "log")):
        found = draw_ospa(
            replace(data, scored=replace(data.scored, columns={**data.scored.columns, "ospa": ospa}))
        ).axes[0]
        assert found.get_yscale() == scale
    assert 0.1 < found.get_ylim()[0] < 0.2


def test_false_and_missed_tracks_are_marked_and_colours_have_marks():
    from dataclasses import replace

    from stereophd.report.plots.scene_plots import draw_views
    from stereophd.report.style import TRACK_COLOURS, dash_of, marker_of

    data = pictures(50)
    labels = [line.get_label() for line in draw_views(data)["top"].axes[0].lines]
    assert "false tracks" not in labels
    assert "missed objects" not in labels
    false, missed = int(data.scored.estimates.label.max()), int(data.truth.object_id.max())
    tables = {
        "purity": {"table": [{"track_id": false, "matched": 1, "estimates": 3}]},
        "completeness": {"table": [{"object_id": missed, "matched": 1, "scans": 3}]},
    }
    wrong = replace(data, report={**data.report, **tables})
    labels = [line.get_label() for line in draw_views(wrong)["top"].axes[0].lines]
    assert {"false tracks", "missed objects"} <= set(labels)
    looks = {(TRACK_COLOURS[k % 7], marker_of(k), str(dash_of(k))) for k in range(56)}
    assert len(looks) == 56


def test_a_figure_is_arranged_once_for_all_its_files(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    from stereophd.report.style import new_figure, save_figures

    arranged, plain = [], ConstrainedLayoutEngine.execute
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda *words: arranged.append(plain(*words)))
    figure = new_figure(3.0, 2.0)
    figure.subplots()
    save_figures({"one": figure}, {f"one.{kind}": tmp_path / f"one.{kind}" for kind in ("png", "svg")})
    assert len(arranged) == 1
