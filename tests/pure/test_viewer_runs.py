"""Snapshots of run folders and of a running system: the same map, path and images; a bounded rate."""

import json
import shutil
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from command_line import exit_code
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.trajectory import Component
from sigmasplat.errors import ConfigError, RunError, SigmaSplatError
from sigmasplat.input.lists import read_poses
from sigmasplat.plugins.evaluation.evaluate import evaluate
from sigmasplat.plugins.evaluation.reconstruct import FusionInput
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.plugins.viewer.layers import merged
from sigmasplat.plugins.viewer.server import free_port, is_loopback, open_server, url_of
from sigmasplat.plugins.viewer.snapshot import Snapshot
from sigmasplat.plugins.viewer.snapshot_sources import (
    ACTIVE_SHARE,
    LiveView,
    SubmapCache,
    finished_snapshot,
)
from sigmasplat.run.session import Session
from sigmasplat.run_folder.runs import TRUTH, RunFolder
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOM, FRAMES = "synthetic:frames=120,width=64,height=48", 14


def settings(**more: str) -> Config:
    quick = {"input.width": "64", "mapping.first_iterations": "4", "mapping.iterations": "2", "submaps.distance_m": "0",
             "submaps.uncertainty_m": "0", "submaps.frames": "5", "loops.close": "no",
             "final.iterations": "3"}  # fmt: skip
    return override(preset(default_preset()), quick | more)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Run SLAM on a few frames in three submaps, and evaluate the run."""
    config = settings()
    source = open_source(ROOM, override(config, {"input.limit": str(FRAMES)}).input)
    run = RunFolder.create(tmp_path_factory.mktemp("view") / "run", config, "room")
    Session(Slam(config, run.submaps), source, run).execute()
    evaluate(run, source, views_per_kind=1, strips_per_kind=0)
    return run


def test_a_finished_run_is_shown_as_it_was_written(finished: RunFolder) -> None:
    shown = finished_snapshot(finished)
    assert shown.final is not None and torch.equal(shown.final.field.params, finished.read_map().params)
    np.testing.assert_array_equal(shown.path.T_world_camera, finished.read_trajectory().T_world_camera)
    log = finished.read_log()
    assert shown.path.submaps.tolist() == [r["submap"] for r in log] and shown.path.submaps[-1] == 2
    assert list(shown.path.keyframes) == [i for i, r in enumerate(log) if r["is_keyframe"]]
    assert not shown.pieces and not shown.live and shown.status == "complete"
    assert shown.camera == finished.submaps.load(0).camera


def test_keyframe_images_come_from_the_submaps(finished: RunFolder) -> None:
    shown, source = finished_snapshot(finished), open_source(ROOM)
    for row in shown.path.keyframes:
        picture = shown.image(row)
        assert picture is not None
        np.testing.assert_allclose(picture / 255.0, source.frame(row).color, atol=0.003)
    other = next(row for row in range(FRAMES) if row not in shown.path.keyframes)
    assert shown.image(other) is None


def test_submaps_are_read_once_and_within_the_budget(finished: RunFolder) -> None:
    anchors, cache = finished.read_checkpoint()[0]["T_world_submap"].numpy(), SubmapCache(finished.submaps)
    cache.load(anchors[:2])
    before = dict(cache.pieces)
    cache.load(anchors)
    assert list(before) == [0, 1] and list(cache.pieces) == [0, 1, 2]
    for index, piece in cache.pieces.items():
        assert torch.equal(piece.field.params, finished.submaps.load(index).field.params)
        np.testing.assert_array_equal(piece.T_world_piece, anchors[index])
    assert all(cache.pieces[i].field is before[i].field for i in before), "the same objects: nothing is sent again"
    small = SubmapCache(finished.submaps, budget=500)
    small.load(anchors)
    assert sum(len(piece.field) for piece in small.pieces.values()) <= 500


def test_a_run_without_a_map_is_refused(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run", settings(), "room")
    for status in ("running", "failed"):
        run.note(status=status)
        with pytest.raises(RunError, match=r"has no map\.ply; did it stop before writing it\? run it again"):
            finished_snapshot(run)


def test_the_stored_true_path_is_aligned_and_gives_the_same_ate(finished: RunFolder) -> None:
    aligned, path = read_poses(finished.path / TRUTH), finished.read_trajectory()
    assert len(aligned) == FRAMES
    np.testing.assert_allclose(aligned.timestamps_s, path.timestamps_s, atol=1e-8)
    away_m = np.linalg.norm(aligned.T_world_camera[:, :3, 3] - path.T_world_camera[:, :3, 3], axis=1)
    assert np.sqrt((away_m**2).mean()) == pytest.approx(finished.read_metrics()["ate"]["rmse_m"], rel=1e-6)
    T = open_source(ROOM).truth().T_world_camera  # type: ignore[union-attr]
    motion = se3.inverse(aligned.T_world_camera[0]) @ aligned.T_world_camera[5]
    np.testing.assert_allclose(motion, se3.inverse(T[0]) @ T[5], atol=1e-9)
    shown = finished_snapshot(finished).true_positions
    np.testing.assert_array_equal(shown, aligned.T_world_camera[:, :3, 3])  # type: ignore[arg-type]


class RoomWithoutTruth(SyntheticRoom):
    """The synthetic room without ground truth."""

    def truth(self) -> None:
        return None


def test_an_evaluation_without_truth_removes_the_stored_true_path(finished: RunFolder, tmp_path: Path) -> None:
    copied = RunFolder(tmp_path / "run")
    shutil.copytree(finished.path, copied.path)
    assert (copied.path / TRUTH).is_file()
    evaluate(copied, RoomWithoutTruth(frames=120, width=64, height=48), views_per_kind=1, strips_per_kind=0)
    assert not (copied.path / TRUTH).exists() and finished_snapshot(copied).true_positions is None


def rewritten(finished: RunFolder, folder: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> RunFolder:
    """Return a copy of the run with other lines in its log."""
    shutil.copytree(finished.path, folder)
    lines = [json.dumps(change(record)) + "\n" for record in finished.read_log()]
    (folder / "log.jsonl").write_text("".join(lines))
    return RunFolder(folder)


def with_states(record: dict[str, Any]) -> dict[str, Any]:
    """Frame 2 is lost; the frames of submap 2 are apart, the second of them is lost."""
    component = int(record["submap"] == 2)
    lost = record["index"] in (2, FRAMES - 1)
    return record | {"lost": lost, "state": "lost" if lost else "apart" if component else "tracked",
                     "component": component}  # fmt: skip


def test_lost_frames_and_submaps_apart_of_a_finished_run(finished: RunFolder, tmp_path: Path) -> None:
    run, path = rewritten(finished, tmp_path / "run", with_states), finished.read_trajectory()
    in_world = [record["submap"] < 2 for record in finished.read_log()]
    run.write_trajectory(path.at(np.array(in_world) & (np.arange(FRAMES) != 2)))
    run.write_components([Component(1, run.read_map(), path.at(~np.array(in_world)))])
    shown = finished_snapshot(run)
    assert shown.path.inside.tolist() == in_world and np.flatnonzero(shown.path.lost).tolist() == [2, FRAMES - 1]
    np.testing.assert_allclose(shown.path.T_world_camera[2], path.T_world_camera[2], atol=1e-9)
    _, total = FusionInput.of(run, open_source(ROOM).camera).views()
    assert total == sum(len(run.submaps.load(i).frames) for i in (0, 1))


class Clock:
    """A simulated clock: each frame takes `frame_s`, each reading `look_s`; the copy lies between two readings."""

    def __init__(self, frame_s: float, look_s: float = 0.0) -> None:
        self.now_s, self.frame_s, self.look_s = 0.0, frame_s, look_s

    def __call__(self) -> float:
        self.now_s += self.look_s
        return self.now_s


def live_run(tmp_path: Path, clock: Clock, budget: int = 300_000) -> tuple[list[Snapshot], Slam]:
    config, source, shown = settings(), open_source(ROOM), list[Snapshot]()
    slam = Slam(config, DiskStore(tmp_path / "submaps"))
    view = LiveView(slam, shown.append, "room", budget, every_s=2.0, clock=clock)
    for i in range(FRAMES):
        clock.now_s += clock.frame_s
        view(slam.step(source.frame(i)))
    slam.finish(view.finishing)
    view.last_loops([])
    return shown, slam


def test_a_running_system_is_shown_from_copies_at_a_bounded_rate(tmp_path: Path) -> None:
    shown, slam = live_run(tmp_path, Clock(0.5))
    steps = shown[:-2]  # the last two show the start of refinement, and the end
    assert [len(s.path) for s in steps] == [1, 5, 9, 13]  # every 2 s, at half a second per frame
    assert [p.submap for p in steps[-1].pieces] == list(range(len(steps[-1].pieces)))
    assert len(steps[-1].pieces) == int(steps[-1].path.submaps[-1]) + 1
    first = steps[0].pieces[0].field.params
    assert first.data_ptr() != slam.mapper.field.params.data_ptr() and torch.isfinite(first).all()
    final = shown[-1].final
    assert final is not None and torch.equal(final.field.params, slam.field.params)
    np.testing.assert_array_equal(shown[-1].path.T_world_camera, slam.trajectory().T_world_camera)
    assert all(s.live and s.true_positions is None for s in shown)


def test_the_live_map_and_its_images_equal_those_of_the_system(tmp_path: Path) -> None:
    shown, slam = live_run(tmp_path, Clock(10.0))  # a snapshot is due at each frame
    assert len(shown) == FRAMES + 2
    source = open_source(ROOM)
    before_final = shown[-2]
    kept = [slam.store.load(i).field.moved(torch.from_numpy(slam.atlas.anchors[i])).params for i in range(3)]
    torch.testing.assert_close(
        merged(before_final.pieces, False, slam.config.render, "auto").field.params, torch.cat(kept)
    )
    for row in slam.keyframe_indices:
        picture = shown[-1].image(row)
        assert picture is not None
        np.testing.assert_allclose(picture / 255.0, source.frame(row).color, atol=0.003)


def test_a_live_map_stays_within_its_budget_and_slow_copies_are_rarer(tmp_path: Path) -> None:
    shown, _ = live_run(tmp_path / "a", Clock(10.0), budget=600)
    assert len(shown) == FRAMES + 2
    for snapshot in shown[:-1]:
        assert sum(len(p.field) for p in snapshot.pieces) <= 600
        if len(snapshot.pieces) == 1:
            assert len(snapshot.pieces[0].field) <= 600 * ACTIVE_SHARE
    assert shown[-1].final is not None and len(shown[-1].final.field) <= 600
    slow, _ = live_run(tmp_path / "b", Clock(1.0, look_s=0.1))  # a copy takes 0.1 s, so it is made every 5 s
    assert [len(s.path) for s in slow[:-2]] == [1, 6, 11]


def test_the_next_free_port_is_used_and_wrong_ports_and_hosts_are_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) <= port + 100
    assert free_port("127.0.0.1", port) == port
    with pytest.raises(ConfigError, match="--port must be from 0 to 65535, found 70000"):
        free_port("127.0.0.1", 70000)
    with pytest.raises(SigmaSplatError, match=r"cannot listen on 203\.0\.113\.7"):
        free_port("203.0.113.7", 0)
    assert url_of("127.0.0.1", 80) == url_of("0.0.0.0", 80) == "http://127.0.0.1:80"
    assert url_of("::1", 81) == "http://[::1]:81" and url_of("box.local", 82) == "http://box.local:82"
    assert [is_loopback(h) for h in ("127.0.0.1", "localhost", "0.0.0.0", "10.0.0.2")] == [True, True, False, False]


def test_without_viser_the_error_names_the_package_to_install(
    finished: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SigmaSplatError, match=r"pip install 'sigmasplat\[viewer\]'"):
        open_server("127.0.0.1", 0, "x")
    for command in (["view", str(finished.path)], ["run", ROOM, "--out", str(tmp_path / "run"), "--view"]):
        assert exit_code(*command) == 2
        said = capsys.readouterr()
        assert said.err.count("\n") == 1 and "sigmasplat[viewer]" in said.err
    assert not (tmp_path / "run").exists()


def test_a_run_without_a_map_cannot_be_viewed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = RunFolder.create(tmp_path / "run", settings(), "room")
    run.note(status="failed")
    for folder, says in (
        (run.path, "has no map.ply; did it stop before writing it?"),
        (tmp_path / "none", "no run folder"),
    ):
        assert exit_code("view", str(folder)) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and says in said
