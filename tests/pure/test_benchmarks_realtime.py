"""The benchmark of real time: which latencies count, and what its table says."""

import importlib
from pathlib import Path
from typing import Any

import pytest

from benchmark_results import laid_out
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run_folder.runs import RunFolder

realtime, replayed = importlib.import_module("realtime"), importlib.import_module("replayed")


def figures(**changed: Any) -> dict[str, Any]:
    usual = {"frames": 10, "lost": 0, "keyframes": 3, "dropped": 0, "ate_cm": 1.1, "psnr_db": 24.0}
    return usual | {"latency_ms": {"p50": 9.0, "p99": 20.0, "worst": 31.0}} | changed


def test_latencies_of_the_first_second_do_not_count(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run", BASE, "made")
    for i in range(60):
        seconds = {"total": 0.01, "latency": 0.5 if i <= 30 else 0.001 * i}
        run.log({"timestamp_s": i / 30, "lost": False, "is_keyframe": i % 10 == 0, "seconds": seconds})
    run.write_metrics({"ate": {"rmse_m": 0.02}, "training": {"psnr_db": 25.0}})
    run.note(dropped=2)
    found = realtime.figures_of(run)
    assert found["latency_ms"]["worst"] == 59.0 and 31 <= found["latency_ms"]["p50"] <= 46
    assert found["ate_cm"] == pytest.approx(2.0) and found["dropped"] == 2 and found["keyframes"] == 6


def test_the_table_compares_both_runs_and_shows_the_goals() -> None:
    other = figures(ate_cm=1.0, psnr_db=24.5, latency_ms=None, dropped=None)
    found = {"source": "room", "seed": 0} | realtime.compared(figures(), other)
    table = laid_out("realtime", {"runs": [found]}, config={"rate": 30.0})["Real time"]
    assert list(table.rows[0]) == ["room", "0", "9.00", "20.0", "31.0", "0", "0", "1.10", "1.10", "0.50"]
    assert list(table.rows[1][2:5]) == ["≤ 12", "≤ 33", "≤ 66"]


@pytest.mark.parametrize("rate_hz", [15.0, 30.0])
def test_a_recording_is_replayed_at_the_wanted_rate(tmp_path: Path, rate_hz: float) -> None:
    recording = tmp_path / "kitchen"
    (recording / "rgb").mkdir(parents=True)
    (recording / "rgb" / "0.png").write_bytes(b"image")
    rows = "".join(f"{i / 15:.6f} rgb/{i}.png\n" for i in range(5))
    for name in ("rgb.txt", "depth.txt"):
        (recording / name).write_text("# timestamp filename\n" + rows)
    (recording / "groundtruth.txt").write_text("0.100000 1 2 3 0 0 0 1\n")
    with replayed.at_rate(recording, rate_hz) as folder:
        assert replayed.rate_of(folder / "rgb.txt") == pytest.approx(rate_hz, rel=1e-4)
        assert (folder == recording) == (rate_hz == 15.0) and folder.name == "kitchen"
        assert (folder / "groundtruth.txt").read_text() == f"{1.5 / rate_hz:.6f} 1 2 3 0 0 0 1\n"
        assert (folder / "rgb.txt").read_text().splitlines()[0] == "# timestamp filename"
        assert (folder / "rgb" / "0.png").read_bytes() == b"image"
    assert (recording / "rgb" / "0.png").exists()


def test_a_folder_without_a_list_of_frames_is_replayed_as_it_is(tmp_path: Path) -> None:
    with replayed.at_rate(tmp_path, 30.0) as folder:
        assert folder == tmp_path
