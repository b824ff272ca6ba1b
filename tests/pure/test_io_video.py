"""Film files: number, size, rate and content of the images are kept; no partial file remains."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from films import read_film
from sigmasplat.errors import RunError
from sigmasplat.plugins.outputs.video import write_video

SIZE = (48, 96)


def images(count: int = 9, size: tuple[int, int] = SIZE) -> list[np.ndarray]:
    """Return images of increasing brightness, red on the left and blue on the right."""
    out = np.zeros((count, *size, 3), np.uint8)
    for i in range(count):
        out[i, :, : size[1] // 2, 0] = out[i, :, size[1] // 2 :, 2] = 60 + 15 * i
    return list(out)


def test_films_are_read_back_as_they_were_written(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_video(tmp_path / "a.mp4", iter(images()), 20.0)
    frames, fps = read_film(tmp_path / "a.mp4")
    assert len(frames) == 9 and fps == pytest.approx(20.0)
    for found, wanted in zip(frames, images(), strict=True):
        assert found.shape == wanted.shape and np.abs(found.astype(int) - wanted)[:, 8:40].mean() < 6
        assert found[:, :40, 0].mean() > found[:, :40, 2].mean(), "red and blue are not swapped"
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert capfd.readouterr().err == ""


def test_films_are_encoded_as_vp9(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", images(3, (49, 97)), 25.0)
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert int(film.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").upper() in (b"VP90", b"VP09")
    assert (film.get(cv2.CAP_PROP_FRAME_WIDTH), film.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (96, 48), (
        "odd sizes are cropped"
    )


def test_an_interrupted_film_leaves_no_file(tmp_path: Path) -> None:
    def breaking() -> Iterator[np.ndarray]:
        yield from images(2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", breaking(), 20.0)
    with pytest.raises(RunError, match="at least one image"):
        write_video(tmp_path / "a.mp4", [], 20.0)
    assert list(tmp_path.iterdir()) == []


def test_unknown_endings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"as a\.avi; give a name that ends in \.mp4"):
        write_video(tmp_path / "a.avi", images(), 20.0)
