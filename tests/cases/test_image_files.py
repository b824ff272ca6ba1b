"""Image files as people have them: turned by EXIF, gray of 16 bits, transparent; depth in EXR, NPZ and JPEG, in floats
of another unit. Each recording is tiny and written here; the handed cases are read too, where they lie."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bag_recordings import CAMERA_TOPICS, FOCAL, Recorder
from command_line import exit_code
from recordings import scene
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import ASSUMED, MEASURED
from sigmasplat.input.opening import open_source
from sigmasplat.input.recorded import depth_warning

CASES = Path(__file__).parents[2].parent / "shared" / "cases"
WIDTH, HEIGHT, FRAMES = 32, 24, 3
CAMERA = {"fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}
RNG = np.random.default_rng(5)
COLORS = RNG.integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), np.uint8)
DEPTHS_M = RNG.uniform(1.0, 3.0, (FRAMES, HEIGHT, WIDTH)).astype(np.float32)
TURNED_BACK = {
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}  # fmt: skip
"""How the camera holds the image that a viewer turns upright again."""


def handed(name: str) -> Path:
    if not (CASES / name).is_dir():
        pytest.skip(f"the handed case {CASES / name} is absent")
    return CASES / name


def write(
    folder: Path,
    color: Callable[[Path, np.ndarray, int], Any] = lambda path, image, i: Image.fromarray(image).save(f"{path}.png"),
    depth: Callable[[Path, np.ndarray], Any] = lambda path, metres: save_millimetres(Path(f"{path}.png"), metres),
    **calibration: float,
) -> Path:
    """Write a plain folder; `color` and `depth` save an image to a path, to which they add an ending."""
    for part in ("color", "depth"):
        (folder / part).mkdir(parents=True)
    for i in range(FRAMES):
        color(folder / f"color/{i}", COLORS[i], i)
        depth(folder / f"depth/{i}", DEPTHS_M[i])
    (folder / "calibration.json").write_text(json.dumps(CAMERA | calibration))
    return folder


def save_millimetres(path: Path, metres: np.ndarray) -> None:
    Image.fromarray(np.rint(1000 * metres).astype(np.uint16)).save(path)


def save_exr(path: Path, values: np.ndarray, channel: str = "Y") -> None:
    openexr = pytest.importorskip("OpenEXR", reason="EXR needs the extra iphone")
    openexr.File({"type": openexr.scanlineimage}, {channel: np.ascontiguousarray(values)}).write(f"{path}.exr")


def save_pfm(path: Path, metres: np.ndarray) -> None:
    header = f"Pf\n{WIDTH} {HEIGHT}\n-1.0\n".encode()
    Path(f"{path}.pfm").write_bytes(header + metres[::-1].astype("<f4").tobytes())


def tagged(path: str, image: Image.Image, orientation: int, **options: Any) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(path, exif=exif, **options)


def colors_of(folder: Path, **options: Any) -> np.ndarray:
    return np.stack([np.rint(255 * frame.color).astype(np.uint8) for frame in open_source(folder, **options)])


def refusal(folder: Path, **options: Any) -> str:
    with pytest.raises(SourceError) as refused:
        open_source(folder, **options)
    return str(refused.value)


@pytest.mark.parametrize("ending", ["png", "tiff", "webp"])
@pytest.mark.parametrize("orientation", TURNED_BACK)
def test_colour_is_turned_as_a_viewer_turns_it_and_depth_is_not(tmp_path: Path, orientation: int, ending: str) -> None:
    def color(path: Path, image: np.ndarray, _: int) -> None:
        held = Image.fromarray(image).transpose(TURNED_BACK[orientation])
        tagged(f"{path}.{ending}", held, orientation, **({"lossless": True} if ending == "webp" else {}))

    def depth(path: Path, metres: np.ndarray) -> None:
        tagged(f"{path}.png", Image.fromarray(np.rint(1000 * metres).astype(np.uint16)), orientation)

    source = open_source(write(tmp_path / "a", color, depth))
    assert np.array_equal(colors_of(tmp_path / "a"), COLORS)
    assert np.allclose(source.frame(1).depth_m, DEPTHS_M[1], atol=6e-4)
    said = source.origins["orientation"]
    assert "EXIF" in said.value and said.origin == f"read from {tmp_path / 'a/color'}/0.{ending}"


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
def test_colour_without_a_tag_or_with_a_damaged_one_stays(tmp_path: Path) -> None:
    def color(path: Path, image: np.ndarray, i: int) -> None:
        Image.fromarray(image).save(f"{path}.png", exif=(b"", b"Exif\0\0no tags", b"Exif\0\0II*\0\xff\xff\xff\xff")[i])

    assert np.array_equal(colors_of(write(tmp_path / "a", color)), COLORS)
    assert "orientation" not in open_source(tmp_path / "a").origins


def test_portrait_by_exif_with_landscape_depth_is_refused_with_a_remedy_that_works(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", lambda path, image, i: tagged(f"{path}.jpg", Image.fromarray(image), 6))
    message = refusal(folder)
    assert f"colour is {HEIGHT}×{WIDTH} (portrait)" in message
    assert "by the EXIF tag of the images (90° clockwise)" in message
    assert f"delete the tag (exiftool -Orientation= {folder / 'color'})" in message
    for path in folder.glob("color/*"):
        Image.open(path).save(path, exif=b"", quality="keep")
    assert open_source(folder).camera.width == WIDTH


def test_portrait_by_exif_with_another_calibration_is_refused_with_the_cause(tmp_path: Path) -> None:
    folder = write(
        tmp_path / "a",
        lambda path, image, i: tagged(f"{path}.jpg", Image.fromarray(image), 8),
        lambda path, metres: save_millimetres(Path(f"{path}.png"), np.rot90(metres)),
        width=WIDTH, height=HEIGHT,
    )  # fmt: skip
    message = refusal(folder)
    assert "the calibration is for 32×24" in message and "EXIF tag of the images (90° anticlockwise)" in message


def test_masks_lie_on_the_image_that_a_viewer_shows(tmp_path: Path) -> None:
    folder = write(
        tmp_path / "a",
        lambda path, image, i: tagged(f"{path}.png", Image.fromarray(image).transpose(TURNED_BACK[3]), 3),
    )
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:5] = 255
    (tmp_path / "masks").mkdir()
    for i, orientation in enumerate((1, 3, 6)):
        held = Image.fromarray(mask).transpose(TURNED_BACK[orientation]) if orientation > 1 else Image.fromarray(mask)
        tagged(f"{tmp_path}/masks/{i}.png", held, orientation)
    for frame in open_source(folder, masks=str(tmp_path / "masks")):
        assert frame.ignored is not None and np.array_equal(frame.ignored, mask > 0)


GRAY = COLORS[..., 0].astype(np.float64) / 256.0
DEEP = {
    "12 bits": (lambda x: (4000 * x).astype(np.uint16), "png", 4096.0),
    "an infrared camera": (lambda x: (500 + 2860 * x).astype(np.uint16), "png", 4096.0),
    "16 bits": (lambda x: (65535 * x).astype(np.uint16), "tiff", 65536.0),
    "dark": (lambda x: (100 * x).astype(np.uint16), "png", 128.0),
    "32 bits": (lambda x: (3000 * x).astype(np.int32), "tiff", 4096.0),
    "floats": (lambda x: x.astype(np.float32), "tiff", 1.0),
}


@pytest.mark.parametrize("kind", DEEP)
def test_deep_gray_has_one_white_for_all_frames(tmp_path: Path, kind: str) -> None:
    """One frame is five times darker: it must stay so."""
    store, ending, white = DEEP[kind]
    values = [store(GRAY[i]) / (5 if i == 1 else 1) for i in range(FRAMES)]
    values = [image.astype(store(GRAY[0]).dtype) for image in values]
    folder = write(tmp_path / "a", lambda path, _, i: Image.fromarray(values[i]).save(f"{path}.{ending}"))
    said, colors = open_source(folder).origins["gray"], colors_of(folder)
    assert said.origin == MEASURED and f"value {white:g} becomes white" in said.value
    for color, image in zip(colors, values, strict=True):
        assert np.abs(color - (image / white * 256)[..., None]).max() <= 1.0
        assert len(np.unique(color)) > 15


def test_a_few_bright_specks_do_not_darken_deep_gray(tmp_path: Path) -> None:
    size = (120, 160)
    values = RNG.integers(100, 3000, (FRAMES, *size)).astype(np.uint16)
    values[:, 0, :5] = 65535
    folder = write(
        tmp_path / "a",
        lambda path, _, i: Image.fromarray(values[i]).save(f"{path}.png"),
        lambda path, metres: save_millimetres(Path(f"{path}.png"), np.full(size, 2.0)),
    )
    colors = colors_of(folder)
    assert "value 4096 " in open_source(folder).origins["gray"].value
    assert (colors[:, 0, :5] == 255).all() and 90 < colors.mean() < 105


def test_deep_gray_that_cannot_be_scaled_is_named(tmp_path: Path) -> None:
    def color(path: Path, image: np.ndarray, i: int) -> None:
        deep = image[..., 0].astype(np.uint16) * 16
        Image.fromarray(deep if i == 1 else image).save(f"{path}.png")

    source = open_source(write(tmp_path / "a", color))
    assert len(list(source)) == FRAMES - 1
    assert "color/1.png: gray of more than 8 bits" in source.skipped[0] and "gray" not in source.origins


def test_transparency_is_said(tmp_path: Path) -> None:
    def color(path: Path, image: np.ndarray, _: int) -> None:
        alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
        alpha[:4] = 0 if path.parent.parent.name == "cut" else 255
        Image.fromarray(np.concatenate([image, alpha], 2)).save(f"{path}.png")

    cut, whole = (open_source(write(tmp_path / name, color)) for name in ("cut", "whole"))
    assert cut.origins["transparency"].origin == ASSUMED and "--masks" in cut.origins["transparency"].option
    assert "transparency" not in whole.origins
    assert np.array_equal(colors_of(tmp_path / "cut"), COLORS)


FLOATS: dict[str, Callable[[Path, np.ndarray], Any]] = {
    "npy": lambda path, metres: np.save(f"{path}.npy", metres),
    "npz": lambda path, metres: np.savez(f"{path}.npz", depth=metres),
    "compressed npz with a scalar": lambda path, metres: np.savez_compressed(f"{path}.npz", arr=metres, near=0.1),
    "float64 npy": lambda path, metres: np.save(f"{path}.npy", metres.astype(np.float64)),
    "tiff": lambda path, metres: Image.fromarray(metres).save(f"{path}.tiff"),
    "pfm": save_pfm,
    "exr": save_exr,
    "exr of a renderer": lambda path, metres: save_exr(path, metres, "Z"),
    "half exr": lambda path, metres: save_exr(path, metres.astype(np.float16), "R"),
}


@pytest.mark.parametrize("kind", FLOATS)
def test_float_depth_is_in_metres_and_only_an_option_changes_that(tmp_path: Path, kind: str) -> None:
    folder = write(tmp_path / "a", depth=FLOATS[kind], depth_scale=1000.0)
    source = open_source(folder)
    tolerance = 2e-3 if kind == "half exr" else 0.0
    assert np.allclose(source.frame(1).depth_m, DEPTHS_M[1], rtol=0, atol=tolerance) and depth_warning(source) is None
    assert source.origins["depth unit"] == ("metres, as usual for floats", ASSUMED, "--depth-scale UNITS")
    halved = open_source(folder, depth_scale=2.0)
    assert np.array_equal(halved.frame(1).depth_m, source.frame(1).depth_m / 2)
    assert np.array_equal(halved.depth_of(1), halved.frame(1).depth_m)


@pytest.mark.parametrize("kind", ["npz", "exr", "pfm"])
def test_lists_of_files_name_depth_of_every_ending(tmp_path: Path, kind: str) -> None:
    folder = write(tmp_path / "a", depth=FLOATS[kind])
    for part, listed in (("color", "rgb.txt"), ("depth", "depth.txt")):
        names = sorted((folder / part).iterdir())
        (folder / listed).write_text("".join(f"{i / 30:.4f} {part}/{p.name}\n" for i, p in enumerate(names)))
    assert np.array_equal(open_source(folder).frame(2).depth_m, DEPTHS_M[2])
    frames = [
        {"file_path": f"color/{i}.png", "depth_file_path": f"depth/{i}.{kind}", "transform_matrix": np.eye(4).tolist()}
        for i in range(FRAMES)
    ]
    for name in ("rgb.txt", "depth.txt", "calibration.json"):
        (folder / name).unlink()
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 30, "cx": 16, "cy": 12, "frames": frames}))
    assert np.array_equal(open_source(folder).frame(2).depth_m, DEPTHS_M[2])


def test_exr_with_nan_has_no_reading_there(tmp_path: Path) -> None:
    """Record3D writes NaN; other float files with NaN are refused."""
    metres = DEPTHS_M[0].copy()
    metres[0, :3] = np.nan, np.inf, -np.inf
    assert (
        open_source(write(tmp_path / "a", depth=lambda path, _: save_exr(path, metres))).depth_of(0) == 0
    ).sum() == 3
    message = refusal(write(tmp_path / "b", depth=lambda path, _: np.savez(f"{path}.npz", metres)))
    assert "0.npz: depth holds 3 NaN or inf pixels; write 0" in message


def bag_in_millimetres(tmp_path: Path) -> Path:
    pytest.importorskip("rosbags")
    seen, recorder = scene((WIDTH, HEIGHT)), Recorder()
    for color, depth, t in zip(seen.colors, seen.depths_mm, seen.times_s, strict=True):
        recorder.image(CAMERA_TOPICS[0], t, color, "rgb8", "optical")
        recorder.image(CAMERA_TOPICS[1], t, depth.astype(np.float32), "32FC1", "optical")
        for topic in CAMERA_TOPICS:
            recorder.info(topic.replace("image_raw", "camera_info"), t, (WIDTH, HEIGHT), FOCAL, "optical")
    return recorder.write(tmp_path / "bag")


MILLIMETRES: dict[str, Callable[[Path], Path]] = {
    "16-bit PNG read as metres": lambda place: write(place / "a", depth_scale=1.0),
    "16-bit PNG read as centimetres": lambda place: write(place / "a", depth_scale=100.0),
    "whole npy": lambda place: write(
        place / "a", depth=lambda p, m: np.save(f"{p}.npy", (1000 * m).astype(np.int32)), depth_scale=1.0
    ),
    **{
        f"floats in {kind}": lambda place, kind=kind: write(
            place / "a", depth=lambda path, metres: FLOATS[kind](path, 1000 * metres)
        )
        for kind in ("npy", "npz", "tiff", "exr", "pfm")
    },
    "a bag": bag_in_millimetres,
}


@pytest.mark.parametrize("kind", MILLIMETRES)
def test_the_unit_that_the_warning_suggests_works_as_printed(tmp_path: Path, kind: str) -> None:
    path = MILLIMETRES[kind](tmp_path)
    warning = depth_warning(open_source(path))
    assert warning is not None and "; --depth-scale 1000 (millimetres) would make it " in warning
    mended = open_source(path, depth_scale=1000.0)
    assert depth_warning(mended) is None and 1.0 < np.median(mended.depth_of(0)) < 3.0


def test_inspect_takes_the_option_for_floats(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write(tmp_path / "a", depth=lambda path, metres: np.save(f"{path}.npy", 1000 * metres))
    sheet = ("--out", str(tmp_path / "sheet.png"))
    exit_code("inspect", str(folder), *sheet)
    assert "--depth-scale 1000" in "".join(capsys.readouterr())
    exit_code("inspect", str(folder), *sheet, "--depth-scale", "1000")
    assert "scale looks wrong" not in "".join(capsys.readouterr())


def test_pgm_keeps_its_values_whatever_largest_value_it_states(tmp_path: Path) -> None:
    for name, most in (("a", 4095), ("b", 10000), ("c", 65535)):

        def depth(path: Path, metres: np.ndarray, most: int = most) -> None:
            values = np.rint(1000 * metres).astype(">u2")
            Path(f"{path}.pgm").write_bytes(f"P5\n{WIDTH} {HEIGHT}\n{most}\n".encode() + values.tobytes())

        source = open_source(write(tmp_path / name, depth=depth, depth_scale=1000.0))
        assert np.allclose(source.depth_of(1), DEPTHS_M[1], atol=6e-4)


@pytest.mark.parametrize("ending", ["jpg", "JPEG", "webp", "mat"])
def test_the_files_in_place_of_depth_are_named(tmp_path: Path, ending: str) -> None:
    def depth(path: Path, metres: np.ndarray) -> None:
        Path(f"{path}.{ending}").write_bytes(b"not looked at")

    message = refusal(write(tmp_path / "a", depth=depth))
    assert f"found 3 other files, such as 0.{ending}" in message and "JPEG loses depth" in message
    assert ".exr" in message and "RGB-only" not in message


def test_depth_of_8_bits_or_as_a_listed_jpeg_is_refused_with_the_reason(tmp_path: Path) -> None:
    pixels = (80 * DEPTHS_M[0]).astype(np.uint8)
    shown = write(tmp_path / "a", depth=lambda path, metres: Image.fromarray(pixels).save(f"{path}.png"))
    listed = write(tmp_path / "b", depth=lambda path, metres: Image.fromarray(pixels).save(f"{path}.jpg"))
    for part, name in (("color", "rgb.txt"), ("depth", "depth.txt")):
        names = sorted(path.name for path in (listed / part).iterdir())
        (listed / name).write_text("".join(f"{i / 30:.4f} {part}/{file}\n" for i, file in enumerate(names)))
    for folder, file in ((shown, "0.png"), (listed, "0.jpg")):
        assert f"{file}: not a depth image (found uint8 (24, 32)); JPEG and 8 bits hold no" in refusal(folder)


def test_an_npz_of_several_images_is_refused_with_its_shapes(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", depth=lambda path, metres: np.savez(f"{path}.npz", depths=DEPTHS_M))
    assert "0.npz: holds [(3, 24, 32)], not one depth image" in refusal(folder)


def test_broken_npz_and_exr_are_refused_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR", reason="EXR needs the extra iphone")
    for name, ending, content in (("a", "npz", b"PK\3\4 broken"), ("b", "npz", b""), ("c", "exr", b"v/1\1 broken")):
        folder = write(tmp_path / name, depth=lambda path, _, e=ending, c=content: Path(f"{path}.{e}").write_bytes(c))
        assert f"depth/0.{ending}: unreadable" in refusal(folder)


def test_the_handed_cases() -> None:
    turned = open_source(handed("08-exif-180") / "rec")
    assert turned.origins["orientation"].value == "turned by the EXIF tag of the images (180°)"
    infrared = open_source(handed("10-infrared-16bit") / "rec")
    assert infrared.frame(0).color.std() > 0.03 and infrared.frame(0).color.max() < 1.0
    floats = handed("09-float-millimetres") / "rec"
    assert "--depth-scale 1000 (millimetres)" in str(depth_warning(open_source(floats)))
    assert depth_warning(open_source(floats, depth_scale=1000.0)) is None
    files = handed("21-depth-in-other-files")
    assert "found 10 other files, such as 0000.jpg" in refusal(files / "jpg")
    assert np.array_equal(open_source(files / "npz").depth_of(3), open_source(files / "exr").depth_of(3))
