"""What the documents print works: their Python runs, their commands parse, the examples do what they say."""

import dataclasses
import functools
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import sigmasplat
import sigmasplat.plugins.sources
from command_line import exit_code
from documents import DOCUMENTS, ROOT, blocks
from module_files import module_from
from sigmasplat import cli
from sigmasplat.commands import options
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.plugins.sources import open_source
from sigmasplat.registry import rows
from sigmasplat.render import render
from sigmasplat.run_folder.runs import FILES, RunFolder

TINY = "synthetic:frames=120,width=64,height=48"
TINY_SETTINGS = {
    "input.width": "64",
    "mapping.first_iterations": "6",
    "mapping.iterations": "4",
    "final.iterations": "5",
}


def example(name: str) -> ModuleType:
    return module_from(ROOT / "examples" / f"{name}.py")


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Make every sequence three frames of 64×48 pixels and every preset short; work in an empty folder."""
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    small, short = open_source(TINY, limit=3), override(preset("varsplat-fast"), TINY_SETTINGS)
    monkeypatch.setattr(sigmasplat, "open_source", lambda path: small)
    monkeypatch.setattr(sigmasplat, "open_scene", lambda path, config: (small, config))
    monkeypatch.setattr(sigmasplat, "preset", lambda name: dataclasses.replace(short, name=preset(name).name))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the smallest demo once; return the folder that holds runs/demo."""
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    place = tmp_path_factory.mktemp("demo")
    settings = [word for pair in TINY_SETTINGS.items() for word in ("--set", "=".join(pair))]
    assert exit_code("run", TINY, "--limit", "3", "--out", str(place / "runs" / "demo"), *settings) == 0
    return place


def test_the_readmes_ten_lines(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = blocks(ROOT / "README.md", "python")
    assert len([line for line in code.splitlines() if line.strip()]) == 10
    exec(compile(code, "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 + 1 and lines[-1].startswith("torch.Size([48, 64, 3])")


@pytest.mark.parametrize("name", ["kernels.md", "own-camera.md", "recipes.md", "runs.md"])
def test_python_in_the_documents(name: str, demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(demo)
    from sigmasplat.fit import losses

    monkeypatch.setattr(losses, "TERMS", dict(losses.TERMS))
    found = blocks(ROOT / "docs" / name, "python")
    assert found
    for code in found:
        exec(compile(code, name, "exec"), {})


def test_the_run_folder_holds_what_the_documents_say(demo: Path) -> None:
    run = demo / "runs" / "demo"
    assert {path.name for path in run.iterdir()} == {*FILES, "run.json", "submaps"}
    text = (ROOT / "docs" / "runs.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in text for name in FILES if name != "report.html") and "report.html" in text
    folder = RunFolder.open(run)
    record, metrics, facts = folder.read_log()[-1], folder.read_metrics(), folder.facts()
    inner = [f"tracking.{k}" for k in record["tracking"]] + [f"seconds.{k}" for k in ("prepare", "track", "total")]
    views = [*metrics["held_out"], *metrics["ate"], *metrics["rpe"], *metrics["uncertainty"]]
    named = {*record, *inner, *metrics, *views, *facts} - {"tracking", "seconds"}
    assert [name for name in sorted(named) if not re.search(rf"\b{re.escape(name)}\b", text)] == []


def test_example_run_sequence(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example("run_sequence").main("any", "out")
    assert capsys.readouterr().out.count("splats") == 3
    assert (tiny / "out" / "trajectory.txt").stat().st_size and (tiny / "out" / "map.ply").stat().st_size


def test_example_render_map(demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    picture = tmp_path / "view.png"
    example("render_map").main(str(demo / "runs" / "demo"), str(picture))
    pixels = np.asarray(Image.open(picture))
    assert pixels.shape == (240, 640, 3) and pixels.std() > 10
    assert "of the view is mapped" in capsys.readouterr().out
    example("render_map").main(str(demo / "runs" / "demo" / "map.ply"), str(picture))
    assert "of the view is mapped" in capsys.readouterr().out


def test_example_own_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    from sigmasplat.fit import losses

    monkeypatch.setattr(losses, "TERMS", dict(losses.TERMS))
    found = example("own_loss").main("15")
    assert found[-1] < 0.7 * found[0]


def test_example_own_uncertainty(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    found = example("own_uncertainty").main("8")
    assert found["ours"] > 0.15 and found["ours"] > found["V, which is of colour"]
    assert found["apart_m"] < 0.005 and found["agreement"] > 0.8
    assert capsys.readouterr().out.count("Spearman") == 2


def test_example_own_channel() -> None:
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    module = example("own_channel")
    assert module.main("20") > 0.85
    source = open_source("synthetic:frames=240,width=64,height=48")
    field, camera = module.seeded(source.frame(0)), source.camera
    features = torch.stack([torch.ones(len(field)), field.colors[:, 0], field.means[:, 2]], 1)
    sums, alpha = module.blended(field, features, camera, np.eye(4))
    seen = render(field, camera, np.eye(4))
    assert torch.allclose(sums[..., 0], alpha, atol=1e-5)  # a channel that is 1 everywhere gathers alpha
    assert torch.allclose(sums[..., 1], seen.color[..., 0], atol=1e-5)
    assert torch.allclose(sums[..., 2], seen.depth, atol=1e-4)


def test_the_example_of_a_format_imports_the_api_only() -> None:
    text = (ROOT / "examples" / "npz_frames.py").read_text(encoding="utf-8")
    assert set(re.findall(r"^(?:from|import) (sigmasplat\S*)", text, re.MULTILINE)) == {"sigmasplat.api"}


def test_a_format_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    extra, data = tmp_path / "extra", tmp_path / "data"
    extra.mkdir()
    data.mkdir()
    (extra / "npz_frames.py").write_text((ROOT / "examples" / "npz_frames.py").read_text(encoding="utf-8"))
    monkeypatch.setattr(sigmasplat.plugins.sources, "__path__", [*sigmasplat.plugins.sources.__path__, str(extra)])
    whole = open_source(TINY, limit=3)
    np.savez(data / "camera.npz", **dataclasses.asdict(whole.camera))
    for frame, T in zip(whole, whole.truth().T_world_camera, strict=False):
        color = np.rint(frame.color * 255).astype(np.uint8)
        arrays = {"t": frame.timestamp_s, "color": color, "depth_m": frame.depth_m, "T_world_camera": T}
        np.savez(data / f"{frame.index:06d}.npz", **arrays)
    rows.cache_clear()
    try:
        source = open_source(data)
        same = [np.array_equal(a.color, b.color) for a, b in zip(source, whole, strict=True)]
        assert same == [True] * 3 and len(source.truth()) == 3
        (data / "000001.npz").write_bytes(b"PK damaged")
        assert [f.index for f in open_source(data)] == [0, 2]
    finally:
        rows.cache_clear()
        sys.modules.pop("sigmasplat.plugins.sources.npz_frames", None)


def commands() -> list[str]:
    """Return every `sigmasplat …` command line of the documents' shell blocks."""
    lines = [line for path in DOCUMENTS for block in blocks(path, "sh") for line in block.splitlines()]
    words = [shlex.split(line, comments=True) for line in lines if re.match(r"(\.venv/bin/)?sigmasplat ", line)]
    return [shlex.join(line) for line in words]


def test_there_are_commands_to_check() -> None:
    assert {line.split()[1] for line in commands()} == set(cli.COMMANDS)


def test_documented_commands_parse(monkeypatch: pytest.MonkeyPatch) -> None:
    def parsed_only(command):
        @functools.wraps(command)
        def stand_in(*args, **named):
            settings, seed = named.get("settings", ()), named.get("seed")
            options.configured(named.get("preset", default_preset()), settings, seed)  # names and values exist
            return 0

        return stand_in

    found = cli.command
    monkeypatch.setattr(cli, "command", lambda name: parsed_only(found(name)))
    assert [line for line in commands() if exit_code(*shlex.split(line)[1:]) != 0] == []
