"""Packing of a shared page: what is read back, its size, and names that look like HTML."""

import base64
import gzip
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from command_line import exit_code
from room_map import room_map
from room_run import made_run
from sigmasplat.data.field import GaussianField
from sigmasplat.data.harmonics import view_colors
from sigmasplat.errors import RunError
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.plugins.outputs.share.page import PLANES, export_page, flat_colours, packed, packed_within, page
from sigmasplat.run_folder.splat_values import SplatValues
from sigmasplat.uncertainty.map_uncertainty import SHIPPED, Background, MapUncertainty, SplatStd

BACKGROUND = Background((0.5, 0.5, 0.5), 0.1, 0.1)


def unpacked(data: bytes, scene: dict[str, Any]) -> dict[str, NDArray[np.float64]]:
    """Read the planes as the page does."""
    b = np.frombuffer(gzip.decompress(data), np.uint8).reshape(PLANES, scene["count"]).astype(float)
    others = (b[12:15].T / 127.5 - 1.0) / np.sqrt(2.0)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(1)))
    quats = np.stack([np.insert(o, int(k), m) for o, k, m in zip(others, b[11], largest, strict=True)])
    return {
        "means": np.array(scene["low"]) + (256.0 * b[:3] + b[4:7]).T * scene["step"],
        "scales": np.exp(scene["scale"][0] + b[8:11].T * scene["scale"][1]),
        "quats": quats,
        "opacities": b[3] / 255.0,
        "colors": b[16:19].T / 255.0,
        "std": np.exp(scene["std"][0] + b[7] * scene["std"][1]) if scene["std"] else np.zeros(0),
    }


def matched(means: NDArray[np.float64], found: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the row of `means` that is nearest to each found one."""
    return np.array([int(np.abs(means - mean).sum(1).argmin()) for mean in found])


def test_packed_splats_are_read_back_within_a_step() -> None:
    field = room_map()
    field.keep(torch.arange(len(field)) % 31 == 0)
    values, rng = SplatValues.of(field), np.random.default_rng(0)
    std_m, shown = rng.uniform(0.002, 0.3, len(field)), rng.random(len(field)) < 0.7
    data, scene = packed(values, std_m, shown)
    found = unpacked(data, scene)
    assert scene["step"] == pytest.approx(np.ptp(values.means, axis=0).max() / 65535.0)
    rows = matched(values.means, found["means"])
    assert sorted(rows) == list(range(len(field)))
    assert scene["shown"] == shown.sum() and shown[rows[: scene["shown"]]].all()
    assert np.abs(found["means"] - values.means[rows]).max() <= 0.51 * scene["step"]
    for name, wanted, step in (
        ("scales", np.exp(values.log_scales[rows]), scene["scale"][1]),
        ("std", std_m[rows], scene["std"][1]),
    ):
        assert np.abs(np.log(found[name] / wanted)).max() <= 0.501 * step < 0.03, name
    cosines = np.abs((found["quats"] * values.quats[rows]).sum(1))
    assert np.degrees(2.0 * np.arccos(np.minimum(cosines, 1.0))).max() < 1.0
    assert np.abs(found["opacities"] - values.opacities[rows]).max() < 1 / 255
    assert np.abs(found["colors"] - np.clip(values.colors[rows], 0.0, 1.0)).max() <= 0.51 / 255


def test_a_map_that_is_too_large_loses_the_splats_that_cover_least() -> None:
    values = SplatValues.of(room_map())
    whole, _ = packed_within(values, None, np.ones(len(values), bool), 10**9)
    data, scene = packed_within(values, None, np.ones(len(values), bool), len(whole) // 2)
    assert 0.4 * len(whole) < len(data) <= len(whole) // 2 and scene["std"] is None
    found = unpacked(data, scene)
    cover = values.opacities * np.exp(np.sort(values.log_scales, axis=1)[:, 1:].sum(1))
    least = np.sort(cover)[-scene["count"]]
    kept = found["opacities"] * np.prod(np.sort(found["scales"], axis=1)[:, 1:], axis=1)
    assert kept.min() > 0.9 * least


def test_colours_are_those_seen_from_the_mean_direction_of_the_keyframes() -> None:
    field = room_map(degree=2)
    toward = torch.randn(len(field), 3, generator=torch.Generator().manual_seed(1))
    known = MapUncertainty(torch.cat([torch.zeros(len(field), 3), toward], 1), BACKGROUND, SHIPPED)
    harmonics = field.attributes["harmonics"].params
    wanted = view_colors(field.colors, harmonics, field.means, field.means + toward)  # each splat has its own camera
    assert torch.allclose(flat_colours(field, known).colors, wanted, atol=1e-5)
    assert torch.equal(flat_colours(field, None).colors, field.colors)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_nan_and_inf_are_refused(value: float) -> None:
    field = room_map()
    field.params[5, 8] = value
    with pytest.raises(RunError, match="nan or inf"):
        flat_colours(field, None)


def test_a_map_without_a_sure_splat_is_refused() -> None:
    values = SplatValues.of(GaussianField.from_values(torch.zeros(1, 3), torch.ones(1), torch.zeros(1, 3)))
    with pytest.raises(RunError, match="no splat that is sure enough"):
        packed(values, np.ones(1), np.zeros(1, bool))


def test_names_are_text_and_cannot_be_code() -> None:
    name = "</title></script><script>alert(1)</script>{{scene}}"
    text = page(name, "<i>", {"name": "</script>"}, b"data", np.zeros((2, 2, 3)))
    assert text.count("<script") == 3 and text.count("</script>") == 3 and "<i></i>" in text
    assert "alert(1)" in text and "&lt;script&gt;alert(1)" in text
    assert json.loads(found(text, "scene")) == {"name": "</script>"}
    assert base64.b64decode(found(text, "splats")) == b"data"


def found(text: str, name: str) -> str:
    """Return the content of a script element of the page."""
    matches = re.findall(rf'<script type="[^"]*" id="{name}">(.*?)</script>', text)
    assert len(matches) == 1
    return str(matches[0])


def test_a_run_is_shared_in_axes_with_y_up_and_nothing_is_loaded_from_elsewhere(tmp_path: Path) -> None:
    run = made_run(tmp_path / "walk", submaps=True)
    assert exit_code("share", str(run.path), "--out", str(tmp_path / "a.html")) == 0
    text = (tmp_path / "a.html").read_text()
    assert not re.findall(r"https?://|@import|url\(", text)
    scene = json.loads(found(text, "scene"))
    frames = RunReader(run).poses_of([0, 2, 4]).T_world_camera
    poses = np.array(scene["keyframes"]).reshape(-1, 4, 4)
    between = np.linalg.inv(poses[0]) @ poses
    assert np.allclose(between, np.linalg.inv(frames[0]) @ frames, atol=1e-4)
    assert np.allclose(poses[:, 1, :3] @ [0.0, 1.0, 0.0], -np.cos(0.5), atol=0.02)  # held 0.5 rad down: y is up
    low, high = np.array(scene["bounds"])
    assert ((low < poses[:, :3, 3]) & (poses[:, :3, 3] < high)).all()
    assert exit_code("share", str(run.path), "--out", str(tmp_path / "a.html")) == 2  # exists
    assert exit_code("share", str(run.path), "--out", str(tmp_path / "a.pdf")) == 2


def test_a_film_and_a_mesh_of_the_same_name_are_written_beside_the_page(tmp_path: Path) -> None:
    run = made_run(tmp_path / "walk", submaps=True)
    (tmp_path / "a.mp4").touch()
    page_alone = ("share", str(run.path), "--out", str(tmp_path / "a.html"))
    assert exit_code(*page_alone, "--film") == 2 and not (tmp_path / "a.html").exists()
    (tmp_path / "a.mp4").unlink()
    assert exit_code(*page_alone, "--film", "--usdz") == 0
    assert zipfile.is_zipfile(tmp_path / "a.usdz")
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) / film.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)
    assert film.get(cv2.CAP_PROP_FRAME_WIDTH) == 40  # colour alone


def test_the_number_of_splats_left_out_is_said(tmp_path: Path) -> None:
    run = made_run(tmp_path / "walk", submaps=True)
    run.write_map(field := room_map())
    std = SplatStd(torch.full((len(field),), 0.01), torch.full((len(field),), 0.01))
    run.write_uncertainty(MapUncertainty(torch.zeros(len(field), 3), BACKGROUND, SHIPPED, std=std))
    said = export_page(RunReader(run), tmp_path / "a.html", most_bytes=400_000)
    assert re.search(r"[\d,]+ that cover least are left out", said)
    assert (tmp_path / "a.html").stat().st_size < 400_000
