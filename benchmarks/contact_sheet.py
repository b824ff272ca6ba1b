"""Draw the contact sheet of all exports that docs/exports.md shows: each file as another program reads it.

Writes every export of a finished run into a folder (those that are there are kept), renders them with three.js, Spark,
Blender, OpenCV and Chromium (other_programs.py), prints what three.js and Blender measure of the meshes, and draws the
pictures as one. A panel whose program is missing is left out. The recording of the committed picture is fr1/xyz of TUM
RGB-D (J. Sturm et al., IROS 2012; CC BY 4.0).

example: python benchmarks/contact_sheet.py runs/desk --node build/readers --blender PYTHON
"""

import json
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import record
import tyro
from other_programs import View, described, in_blender, in_three, photographed
from PIL import Image, ImageDraw, ImageFont, ImageOps
from scipy.spatial.transform import Rotation

from sigmasplat import cli
from sigmasplat.errors import SigmaSplatError
from sigmasplat.types import Matrix

arg = tyro.conf.arg
PANEL, COLUMNS, LINE, GAP = (400, 300), 4, 18, 6
"""Size of a panel, panels in a row, height of a line of text and space between panels, pixels."""
PAPER, INK, DIM = "#15181b", "#e8eaed", "#a4abb3"
WORDS = {
    "desk.ply": ["export"], "desk-plain.ply": ["export", "--plain"], "desk.spz": ["export"], "desk.html": ["share"],
    "desk.mp4": ["export", "--path", "orbit", "--panels", "color", "--seconds", "2"], "desk.plan.png": ["export"],
    "desk-colmap": ["export", "--pictures"], "desk.txt": ["export"], "desk.cov.txt": ["export"],
    "desk.glb": ["mesh"], "desk.usdz": ["mesh"], "desk-mesh.ply": ["mesh"], "desk.stl": ["mesh", "--axes", "z-up"],
}  # fmt: skip
"""The exports: file, command and its options."""
ASIDE_RAD, HIGHER_RAD, FARTHER, ENLARGED = 0.25, 0.2, 1.15, 10.0
"""How far the view of the panels is from that with which a page opens; how many times too large ellipses are."""


@dataclass(frozen=True)
class Options:
    """Draw the contact sheet of all exports."""

    run: Annotated[Path, tyro.conf.Positional, arg(help="folder of a finished run")]
    node: Annotated[Path, arg(help="folder with the packages of Node")] = record.ROOT / "build" / "readers"
    blender: Annotated[Path | None, arg(help="a Python with bpy", help_behavior_hint="(default: left out)")] = None
    keep: Annotated[Path, arg(help="folder of the exported files")] = record.ROOT / "build" / "exports"
    out: Annotated[Path, arg(help="picture to write")] = record.ROOT / "docs" / "images" / "exports.jpg"


def exported(options: Options) -> None:
    """Write the exports that are not there yet. Raises SigmaSplatError if a command fails; it has said why."""
    options.keep.mkdir(parents=True, exist_ok=True)
    for name, (command, *more) in WORDS.items():
        if not (options.keep / name).exists():
            words = [command, str(options.run), "--out", str(options.keep / name), *more]
            try:
                cli.main(words)
            except SystemExit as ended:
                if ended.code:
                    raise SigmaSplatError(f"sigmasplat {' '.join(words)} failed") from ended


def start_view(html: Path, mesh: Path) -> View:
    """Return the view of the panels: that with which a shared page opens, from a little higher and farther aside.

    mesh: a GLB of the same run. It tells the distance of what the view turns about.
    """
    import trimesh  # a part of the extra viewer

    found = re.search(r'id="scene">(.*?)</script>', html.read_text(encoding="utf-8"))
    assert found is not None
    scene = json.loads(found[1])
    T = np.array(scene["keyframes"][scene["start"]]).reshape(4, 4)
    points = trimesh.load(mesh, force="mesh").vertices @ T[:3, :3] - T[:3, 3] @ T[:3, :3]
    ahead = points[(points[:, 2] > 0) & (np.abs(points[:, :2]).max(1) < 0.2 * points[:, 2])]
    center = T[:3, 3] + T[:3, 2] * float(np.median(ahead[:, 2]))
    toward = center - T[:3, 3]
    aside = Rotation.from_rotvec([0.0, -ASIDE_RAD, 0.0]).as_matrix() @ toward
    aside[1] -= np.sin(HIGHER_RAD) * float(np.linalg.norm(toward))
    focal = scene["focal"] * PANEL[0] / scene["width"]
    return View(looking(center - FARTHER * aside, center, np.array([0.0, 1.0, 0.0])), focal, PANEL)


def looking(eye: Matrix, at: Matrix, up: Matrix) -> Matrix:
    """Return T_world_camera [4, 4] of a level camera at `eye` that looks at a point."""
    T = np.eye(4)
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return T


# ---- Files that are read here: text, pictures, films ----


def colmap_panel(folder: Path) -> Image.Image:
    """Draw COLMAP's points, and the pyramid of every view, from behind the first camera."""
    lines = [
        line.split() for line in (folder / "sparse" / "0" / "points3D.txt").read_text().splitlines() if line[0] != "#"
    ]
    points, colors = np.array([line[1:7] for line in lines], np.float64).reshape(-1, 2, 3).swapaxes(0, 1)
    text = [line for line in (folder / "sparse" / "0" / "images.txt").read_text().splitlines() if line[:1] != "#"]
    poses = [np.linalg.inv(_pose(np.array(line.split()[1:8], np.float64))) for line in text[::2] if line]
    values = (folder / "sparse" / "0" / "cameras.txt").read_text().splitlines()[-1].split()[2:]
    width, height, fx = float(values[0]), float(values[1]), float(values[2])
    middle = np.median(points, axis=0)
    eye = poses[0][:3, 3] + np.array([-0.5, -0.8, -0.9]) * 0.6 * np.linalg.norm(middle - poses[0][:3, 3])
    T_view_world = np.linalg.inv(looking(eye, middle, np.array([0.0, -1.0, 0.0])))
    pixels = np.full((2 * PANEL[1], 2 * PANEL[0], 3), 32, np.uint8)
    u, v, z = _projected(points, T_view_world)
    order = np.argsort(-z)
    order = order[(z[order] > 0.05) & (u[order] > 0) & (v[order] > 0) & (u[order] < 799) & (v[order] < 599)]
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        pixels[v[order].astype(int) + dv, u[order].astype(int) + du] = colors[order]
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    x, y = 0.08 * width / fx / 2, 0.08 * height / fx / 2
    corners = np.array([[0, 0, 0], [-x, -y, 0.08], [x, -y, 0.08], [x, y, 0.08], [-x, y, 0.08]])
    for T in poses:
        u, v, _ = _projected(corners @ T[:3, :3].T + T[:3, 3], T_view_world)
        for i, k in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)):
            draw.line([(u[i], v[i]), (u[k], v[k])], "#ffa640", 2)
    return image.resize(PANEL, Image.Resampling.LANCZOS)


def _pose(row: Matrix) -> Matrix:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(row[[1, 2, 3, 0]]).as_matrix(), row[4:]
    return T


def _projected(points: Matrix, T_view_world: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    x, y, z = (points @ T_view_world[:3, :3].T + T_view_world[:3, 3]).T
    focal = 1.8 * PANEL[0]
    return PANEL[0] + focal * x / z, PANEL[1] + focal * y / z, z


def path_panel(path: Path) -> Image.Image:
    """Draw a path of TUM's columns from the front (x right, y down), with the ellipses of its covariances if it has
    them, enlarged."""
    rows = np.loadtxt(path)
    spots, image = rows[:, 1:3], Image.new("RGB", (2 * PANEL[0], 2 * PANEL[1]), "#202428")
    low, high = spots.min(0), spots.max(0)
    scale = 0.8 * min(2 * PANEL[0] / (high - low)[0], 2 * PANEL[1] / (high - low)[1])
    at = (spots - (low + high) / 2) * scale + np.array(PANEL)
    draw = ImageDraw.Draw(image)
    for row, place in list(zip(rows, at, strict=True))[::8] if rows.shape[1] > 8 else []:
        c11, c21, c22 = row[8:11]
        values, axes = np.linalg.eigh(rotation_2d(row) @ np.array([[c11, c21], [c21, c22]]) @ rotation_2d(row).T)
        turn = np.linspace(0.0, 2.0 * np.pi, 40)
        ring = (np.sqrt(np.maximum(values, 0.0)) * ENLARGED * scale)[:, None] * np.stack([np.cos(turn), np.sin(turn)])
        draw.line([tuple(p) for p in (place[:, None] + axes @ ring).T], "#8cc2ff", 2)
    draw.line([tuple(p) for p in at], "#ffa640", 3)
    bar = 0.1 * scale
    draw.line([(20, 575), (20 + bar, 575)], INK, 4)
    draw.text((30 + bar, 575), "10 cm", INK, ImageFont.load_default(26), anchor="lm")
    return image.resize(PANEL, Image.Resampling.LANCZOS)


def rotation_2d(row: Matrix) -> Matrix:
    """Return what of a pose's rotation [2, 2] acts on x and y; the covariance is in the axes of the camera."""
    turned: Matrix = Rotation.from_quat(row[4:8]).as_matrix()[:2, :2]
    return turned


def film_panel(path: Path) -> Image.Image:
    """Return the image in the middle of a film, as OpenCV reads it."""
    film = cv2.VideoCapture(str(path))
    film.set(cv2.CAP_PROP_POS_FRAMES, int(film.get(cv2.CAP_PROP_FRAME_COUNT)) // 2)
    return Image.fromarray(film.read()[1][..., ::-1].copy())


# ---- The sheet ----


def panels(options: Options) -> dict[str, Callable[[], Any]]:
    """Return what draws each panel, by its caption: a picture, or a picture and what was measured."""
    files, node = options.keep, options.node
    view = start_view(files / "desk.html", files / "desk.glb")
    html, report = (path.resolve().as_uri() for path in (files / "desk.html", options.run / "report.html"))
    half = np.pi / 2

    def three(name: str, turn: float = 0.0, kind: str = "") -> Callable[[], Any]:
        return lambda: in_three(files / name, view, node, turn, kind)

    def blender(name: str) -> dict[str, Callable[[], Any]]:
        python = options.blender
        return {} if python is None else {f"{name}|Blender": lambda: in_blender(files / name, view, python)}

    return {
        "desk.ply|Spark": three("desk.ply", 2 * half, "splats"),
        "desk-plain.ply|Spark": three("desk-plain.ply", 2 * half, "splats"),
        "desk.spz|Spark": three("desk.spz"),
        "desk.html|Chromium": lambda: photographed(html, (800, 600), "sigmasplat.ready()"),
        "desk.html|Chromium, as on a phone": lambda: photographed(html, (390, 844), "sigmasplat.ready()", phone=True),
        "desk.glb|three.js": three("desk.glb"),
        **blender("desk.glb"),
        "desk.usdz|three.js": three("desk.usdz"),
        "desk-mesh.ply|three.js": three("desk-mesh.ply", 0.0, "ply"),
        "desk.stl|three.js": three("desk.stl", -half),
        "desk.mp4|OpenCV": lambda: film_panel(files / "desk.mp4"),
        "desk.plan.png|Pillow": lambda: Image.open(files / "desk.plan.png").convert("RGB"),
        "report.html|Chromium": lambda: photographed(report, (800, 600), "document.readyState == 'complete'"),
        "desk-colmap|its text": lambda: colmap_panel(files / "desk-colmap"),
        "desk.txt|NumPy": lambda: path_panel(files / "desk.txt"),
        "desk.cov.txt|NumPy": lambda: path_panel(files / "desk.cov.txt"),
    }


def fitted(image: Image.Image) -> Image.Image:
    """Return a picture within a panel."""
    panel, small = Image.new("RGB", PANEL, "#202428"), ImageOps.contain(image, PANEL, Image.Resampling.LANCZOS)
    panel.paste(small, ((PANEL[0] - small.width) // 2, (PANEL[1] - small.height) // 2))
    return panel


def size_of(path: Path) -> str:
    """Write the size of a file, or of all files in a folder."""
    size = sum(p.stat().st_size for p in path.rglob("*") if p.is_file()) if path.is_dir() else path.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"


def sheet(made: dict[str, Image.Image], sizes: dict[str, str]) -> Image.Image:
    """Draw the panels with their file, its size, and the program that read it."""
    rows, (width, height) = -(-len(made) // COLUMNS), (PANEL[0] + GAP, PANEL[1] + LINE + GAP)
    page = Image.new("RGB", (COLUMNS * width + GAP, rows * height + GAP), PAPER)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(14)
    for i, (caption, image) in enumerate(made.items()):
        x, y, (name, program) = GAP + i % COLUMNS * width, GAP + i // COLUMNS * height, caption.split("|")
        page.paste(fitted(image), (x, y + LINE))
        draw.text((x, y), f"{name} · {sizes[name]}", INK, font)
        draw.text((x + PANEL[0], y), program, DIM, font, anchor="ra")
    return page


def main(options: Options) -> int:
    """Write the exports and the picture; exit code 1 if a panel failed, or if two programs measure different meshes."""
    exported(options)
    made, extents, failed = dict[str, Image.Image](), dict[str, list[float]](), 0
    for caption, draw in panels(options).items():
        try:
            found = draw()
        except (SigmaSplatError, AssertionError) as problem:
            print(f"{caption}: {problem}", file=sys.stderr)
            failed += 1
            continue
        pixels, facts = found if isinstance(found, tuple) else (found, {})
        made[caption] = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
        if "size_m" in facts:
            print(described(caption.replace("|", " in "), facts))
            extents[caption] = sorted(facts["size_m"])
    names = {caption.split("|")[0] for caption in made}
    sizes = {name: size_of(options.run / name if name == "report.html" else options.keep / name) for name in names}
    sheet(made, sizes).save(options.out, quality=82, optimize=True)
    print(f"{options.out}: {options.out.stat().st_size / 1000:.0f} kB, {len(made)} panels")
    textured = [size for caption, size in extents.items() if caption.startswith(("desk.glb", "desk.usdz"))]
    agree = all(np.allclose(textured[0], size, atol=2e-3) for size in textured)
    if not agree:
        print("the programs do not agree on the size of the textured mesh", file=sys.stderr)
    return int(failed > 0 or not agree)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,))))
