"""The recipes that change the package itself: each is carried out on a copy of it, then used in a fresh process."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from documents import ROOT

PACKAGE = ROOT / "src" / "sigmasplat"
TINY = "synthetic:frames=120,width=64,height=48"


def replace(path: Path, old: str, new: str) -> None:
    """Replace the first occurrence of a text that must be there."""
    source = path.read_text(encoding="utf-8")
    assert old in source, f"{path.name} has no {old!r}"
    path.write_text(source.replace(old, new, 1), encoding="utf-8")


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a copy of the package's sources, with the compiled kernels that are installed."""
    core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    copy = shutil.copytree(PACKAGE, tmp_path / "sigmasplat", ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    shutil.copy(core.__file__, copy / "native")
    return copy


@pytest.fixture
def run(package: Path) -> Callable[[str], None]:
    """Return a function that runs Python code with the copy of the package."""

    def with_the_copy(code: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, "-c", f"import sigmasplat; assert {str(package)!r} in sigmasplat.__file__\n{code}"]
        ended = subprocess.run(command, capture_output=True, text=True, cwd=package.parent, env=environment)
        assert ended.returncode == 0, ended.stderr

    return with_the_copy


def test_a_preset_is_values_and_a_setting_is_a_field(package: Path, run: Callable[[str], None]) -> None:
    presets = package / "plugins" / "presets"
    (presets / "mine.py").write_text(
        '"""Settings for my robot."""\n\nfrom sigmasplat.api import Preset, preset\n'
        "from sigmasplat.config.text import override\n\n"
        "SET = {'input.width': '480', 'tracking.patience_s': '0.5'}\n"
        'PLUGIN = Preset("robot", lambda: override(preset("sigma"), SET))\n',
        encoding="utf-8",
    )
    with (presets / "values" / "varsplat.toml").open("a", encoding="utf-8") as tables:
        tables.write('[office]\nlike = "tum"\n')
    frames = package / "config" / "tracking.py"
    source = frames.read_text(encoding="utf-8")
    method = source.index("\n    method: ", source.index("class TrackingConfig")) + 1
    field = '    patience_s: float = 0.0\n    """Seconds to wait for a frame."""\n'
    frames.write_text(source[:method] + field + source[method:], encoding="utf-8")
    run(
        "from sigmasplat.config.text import override\n"
        "from sigmasplat.errors import ConfigError\n"
        "from sigmasplat.config.find_preset import list_presets, preset\n"
        "robot = preset('robot')\n"
        "assert (robot.name, robot.input.width, robot.tracking.patience_s) == ('robot', 480, 0.5)\n"
        "assert {'robot', 'varsplat-office', 'loopsplat-office'} <= set(list_presets())\n"
        "changed = override(preset('sigma'), {'tracking.patience_s': '2'})\n"
        "assert changed.tracking.patience_s == 2.0 and changed.to_dict()['tracking']['patience_s'] == 2.0\n"
        "try:\n    override(robot, {'tracking.pateince_s': '2'})\n"
        "except ConfigError as problem:\n    assert 'patience_s' in str(problem)\n"
        "else:\n    raise AssertionError('a misspelt name was accepted')\n"
    )


def test_a_rule_is_a_function_and_a_descriptor_a_class(package: Path, run: Callable[[str], None]) -> None:
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    with (package / "tracking" / "keyframe_rule.py").open("a", encoding="utf-8") as rules:
        rules.write("\n\ndef is_keyframe(*arguments):\n    return True\n")
    loops = package / "graph"
    with (package / "tracking" / "descriptors.py").open("a", encoding="utf-8") as descriptors:
        descriptors.write(
            "\n\nclass MeanColor:\n    def describe(self, color, depth_m):\n"
            "        mean = color.mean((0, 1))\n        return mean / np.linalg.norm(mean)\n"
        )
    replace(package / "config" / "submaps.py", 'Literal["grid", "netvlad",', 'Literal["grid", "mean", "netvlad",')
    replace(loops / "closer.py", "import Descriptor, OrientationGrid", "import Descriptor, MeanColor, OrientationGrid")
    replace(
        loops / "closer.py",
        '    if config.descriptor == "grid"',
        '    if config.descriptor == "mean":\n        return MeanColor()\n    if config.descriptor == "grid"',
    )
    run(
        "from sigmasplat import Slam, open_source, preset\n"
        "from sigmasplat.config.text import override\n"
        "short = {'input.width': '64', 'mapping.first_iterations': '4', 'mapping.iterations': '2',\n"
        "         'loops.descriptor': 'mean', 'final.iterations': '0', 'submaps.frames': '2'}\n"
        "slam = Slam(override(preset('varsplat-fast'), short))\n"
        f"steps = [slam.step(frame) for frame in open_source({TINY!r}, limit=4)]\n"
        "slam.finish()\n"
        "assert all(step.is_keyframe for step in steps) and len(slam.atlas.anchors) > 1\n"
    )


def test_an_attribute_of_splats_is_a_name_a_width_and_a_rate(package: Path, run: Callable[[str], None]) -> None:
    replace(
        package / "data" / "field.py",
        'ATTRIBUTES = {"harmonics": 45}',
        'ATTRIBUTES = {"heat": 2, "harmonics": 45}',
    )
    rates = package / "fit" / "adam.py"
    replace(rates, 'ATTRIBUTE_RATES = {"harmonics"', 'ATTRIBUTE_RATES = {"heat": ("colors", 0.5), "harmonics"')
    run(
        "import torch\n"
        "from sigmasplat.data.field import GaussianField\n"
        "field = GaussianField.from_values(torch.rand(5, 3), torch.full((5,), 0.1), torch.rand(5, 3))\n"
        "field.get_or_create('heat')\n"
        "field.attributes['heat'].params[:, 1] = torch.arange(5.0)\n"
        "field.append(GaussianField.from_values(torch.rand(2, 3), torch.full((2,), 0.1), torch.rand(2, 3)))\n"
        "field.keep(torch.tensor([False, True, False, False, True, True, False]))\n"
        "assert field.attributes['heat'].params[:, 1].tolist() == [1.0, 4.0, 0.0]\n"
    )
