"""What looks the same from several places: the path may be wrong there, but never in silence."""

from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.graph.confidence import places_alike
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.slam.results import Step
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.prepared_frame import observe, view_of, working_frame

OFF_M, FRAMES = 0.05, 14
TILES = Path(__file__).parents[2] / "../shared/cases/17-repeated-tiles"
FEW_STEPS = {"mapping.first_iterations": "10", "mapping.iterations": "4", "final.iterations": "0"}
CONFIG = override(preset("sigma"), {"input.width": "160", **FEW_STEPS})


def followed(source: Source) -> list[Step]:
    """Track the first frames."""
    slam = Slam(CONFIG)
    return [slam.step(source.frame(i)) for i in range(FRAMES)]


def errors_m(source: Source, steps: list[Step]) -> np.ndarray:
    truth = source.truth()
    assert truth is not None
    true = se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera[: len(steps)]
    return np.linalg.norm(np.stack([step.T_world_camera for step in steps])[:, :3, 3] - true[:, :3, 3], axis=1)


def declared(steps: list[Step]) -> np.ndarray:
    return np.array([step.lost or step.p_off > 0.5 for step in steps])


@pytest.mark.parametrize("paint", [2, 3], ids=["tiles", "blank"])
def test_a_wall_that_looks_the_same_everywhere_is_never_wrong_in_silence(paint: int) -> None:
    source = open_source(f"synthetic:wall={paint},frames={FRAMES},noise=1")
    steps = followed(source)
    off = errors_m(source, steps) > OFF_M
    assert off.sum() > FRAMES // 2, "the path must be wrong, or the test proves nothing"
    assert declared(steps)[off].all()
    assert any("nothing confirms" in step.diagnosis for step in steps)


def test_a_painted_wall_is_right_and_sure() -> None:
    source = open_source(f"synthetic:wall=1,frames={FRAMES},noise=1")
    steps = followed(source)
    assert errors_m(source, steps).max() < 0.01
    assert max(step.p_off for step in steps) < 0.02


@pytest.mark.skipif(not TILES.is_dir(), reason=f"no {TILES}")
def test_the_tiles_of_a_user_are_never_wrong_in_silence() -> None:
    steps = followed(open_source(str(TILES / "rec")))
    true_m = np.loadtxt(TILES / "truth.txt")[: len(steps), 1:4]
    found_m = np.stack([step.T_world_camera[:3, 3] for step in steps])
    off = np.linalg.norm(found_m - (true_m - true_m[0]), axis=1) > OFF_M
    assert off.any() and declared(steps)[off].all()


@pytest.mark.skipif(not TILES.is_dir(), reason=f"no {TILES}")
def test_a_run_says_at_its_end_that_nothing_confirms_the_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = [word for pair in FEW_STEPS.items() for word in ("--set", "=".join(pair))]
    asked = ("--limit", "12", "--no-eval", "--set", "input.width=160", *few)
    assert exit_code("run", str(TILES / "rec"), "--out", str(tmp_path / "tiles"), *asked) == 0
    assert "the images do not confirm the path in" in " ".join(capsys.readouterr().err.split())
    walk = "synthetic:frames=200,width=160,height=120"
    assert exit_code("run", walk, "--out", str(tmp_path / "room"), *asked) == 0
    assert "do not confirm" not in " ".join(capsys.readouterr().err.split())


def test_a_furnished_room_looks_like_no_other_place() -> None:
    room = SyntheticRoom(frames=60, width=160, height=120)
    for i in (0, 20, 40):
        frame = working_frame(room.frame(i), CONFIG)
        assert places_alike(observe(room.frame(i), frame, view_of(frame.camera, CONFIG), None).live) == 1
