"""Probe views: frames that the map is not fitted to, on which its uncertainty is calibrated."""

from pathlib import Path

import numpy as np
import pytest
import torch

from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.errors import ConfigError
from sigmasplat.final.stores import RefinedStore
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.system.slam import Slam
from sigmasplat.uncertainty.map_uncertainty import SHIPPED

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOM, FRAMES, HOLD = "synthetic:frames=120,width=80,height=60,noise=1", 40, 8
SETTINGS = {
    "input.width": "80", "input.limit": str(FRAMES), "input.hold_every": str(HOLD), "mapping.first_iterations": "8",
    "mapping.iterations": "4", "submaps.frames": "20", "final.iterations": "6", "loops.close": "off",
}  # fmt: skip


def settings(probes: int) -> Config:
    return override(preset("sigma"), SETTINGS | {"uncertainty.probes": str(probes)})


def finished(probes: int, folder: Path | None = None) -> Slam:
    config = settings(probes)
    slam = Slam(config, None if folder is None else DiskStore(folder))
    for frame in open_source(ROOM, config.input):
        slam.step(frame)
    slam.finish()
    return slam


def test_probe_views_are_tracked_frames_that_nothing_is_fitted_to(tmp_path: Path) -> None:
    slam = finished(2, tmp_path / "submaps")
    path, found = slam.trajectory().T_world_camera, []
    refined = RefinedStore(slam.store, [slam.atlas.refined[s] for s in range(len(slam.store))])
    for s in range(len(slam.store)):
        submap = slam.store.load(s)
        assert len(submap.probe_frames) <= 2
        for k, (frame, pose) in enumerate(zip(submap.probe_frames, submap.T_submap_probe, strict=True)):
            assert frame not in slam.keyframe_indices and frame % HOLD != HOLD - 1
            assert slam.steps[frame].state == "tracked" and slam.steps[frame].submap == s
            assert np.allclose(pose, slam.atlas.T_submap_camera[frame])
            assert np.allclose(slam.atlas.anchors[s] @ refined.load(s).T_submap_probe[k], path[frame])
            image = slam.store.probe(s, k)
            assert image.color.shape == (60, 80, 3) and image.depth_m.shape == (60, 80)
            found.append(frame)
    assert len(found) == len(set(found)) >= len(slam.store)
    assert slam.uncertainty is not None and slam.uncertainty.probes == len(found)


def test_probe_views_change_no_bit_of_the_map() -> None:
    without, with_probes = finished(0), finished(2)
    assert without.uncertainty is None and with_probes.uncertainty is not None
    assert torch.equal(without.field.params, with_probes.field.params)
    assert np.array_equal(without.trajectory().T_world_camera, with_probes.trajectory().T_world_camera)
    assert len(with_probes.uncertainty.splats) == len(with_probes.field)
    assert with_probes.uncertainty.calibration != SHIPPED


def test_measuring_the_uncertainty_is_part_of_the_progress() -> None:
    config, told = settings(2), list[tuple[int, int]]()
    slam = Slam(config)
    for frame in open_source(ROOM, config.input):
        slam.step(frame)
    slam.finish(lambda done, total: told.append((done, total)))
    done, totals = zip(*told, strict=True)
    assert len(set(totals)) == 1 and list(done) == sorted(done)
    assert done[0] == 0 and done[-1] == totals[0] > config.final.iterations
    assert len([step for step in done if step > config.final.iterations]) > len(slam.store)


def test_a_negative_number_of_probe_views_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"uncertainty\.probes"):
        settings(-1)
