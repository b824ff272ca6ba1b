"""Code above `render` asks one table what a device does (fit/backends.py); nothing else chooses by device."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

from sigmasplat.fit import losses
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.losses import FUSED_TERMS, PIXEL_TERMS, SHAPE_TERMS, pixel_weights
from sigmasplat.render.backend import backend_names

PACKAGE = Path(__file__).parents[2] / "src" / "sigmasplat"
MAY_CHOOSE = ("render/", "native/", "fit/cpu.py", "plugins/cuda/", "fit/backends.py")
"""Where code may depend on the device."""
MAY_NAME = (*MAY_CHOOSE, "config/__init__.py", "env.py", "plugins/checks/installation.py", "run_folder/state.py")
"""Those, and what reads the setting, describes the machine, or puts tensors back where they were."""
DEVICE_CLASS = re.compile(r"(View|Step|Level)$")


def parts(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def classes_asked_for(tree: ast.AST) -> Iterator[str]:
    """Yield the names of the classes in `isinstance(…, classes)` and in `case Class():`."""
    for node in ast.walk(tree):
        asked: list[ast.expr] = []
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance":
            asked = node.args[1:]
        elif isinstance(node, ast.MatchClass):
            asked = [node.cls]
        for expression in asked:
            for name in ast.walk(expression):
                if isinstance(name, ast.Name | ast.Attribute):
                    yield name.id if isinstance(name, ast.Name) else name.attr


def choices_by_device(tree: ast.AST) -> list[str]:
    """List what in a file chooses by device: tests of classes, comparisons of a backend's name."""
    found = [name for name in classes_asked_for(tree) if DEVICE_CLASS.search(name)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare | ast.Subscript | ast.Match):
            names = [n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute)]
            found += [name for name in names if name == "backend"]
    return found


def names_of_devices(tree: ast.AST) -> list[str]:
    """List what in a file asks where a tensor is, or names CUDA."""
    found = list[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and (
            node.attr == "is_cuda"
            or (node.attr == "type" and isinstance(node.value, ast.Attribute | ast.Name) and "device" in ast.dump(node))
        ):
            found.append(ast.unparse(node))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and re.match(r"cuda(:\d+)?$", node.value):
            found.append(node.value)
    return found


def tensors_asked_for(tree: ast.AST) -> list[str]:
    """List tests for `Tensor`: in a fit they mean "is on a device"."""
    return [name for name in classes_asked_for(tree) if name == "Tensor"]


def offenders(check, allowed: tuple[str, ...], folders: tuple[str, ...] = ("",)) -> dict[str, list[str]]:  # type: ignore[no-untyped-def]
    files = (p for p in PACKAGE.rglob("*.py") if parts(p).startswith(folders) and not parts(p).startswith(allowed))
    found = {parts(path): check(ast.parse(path.read_text(encoding="utf-8"))) for path in files}
    return {path: lines for path, lines in found.items() if lines}


def test_nothing_but_the_table_chooses_by_device() -> None:
    assert offenders(choices_by_device, MAY_CHOOSE) == {}
    assert offenders(names_of_devices, MAY_NAME) == {}
    # A file of weights may hold other things than tensors.
    assert offenders(tensors_asked_for, (*MAY_CHOOSE, "graph/netvlad.py"), ("fit/", "slam/")) == {}


def test_the_checks_notice_what_they_are_for() -> None:
    for code in (
        "isinstance(view, CudaView)", "isinstance(x.view, render.CpuView | ReferenceView)", "view.backend == 'cpu'",
        "{'cpu': 1}[view.backend]", "match step:\n case CudaStep(): pass",
    ):  # fmt: skip
        assert choices_by_device(ast.parse(code)), code
    for code in (
        "x.is_cuda",
        "view.sums.device.type == name",
        "device.type",
        "torch.device('cuda:0')",
        "name = 'cuda'",
    ):
        assert names_of_devices(ast.parse(code)), code
    assert tensors_asked_for(ast.parse("isinstance(plane, Tensor)"))
    for code in ("x.to(view.sums.device)", "field.params.device != view.sums.device", "isinstance(x, Camera)"):
        tree = ast.parse(code)
        assert not [*choices_by_device(tree), *names_of_devices(tree), *tensors_asked_for(tree)], code


def test_every_backend_has_a_row() -> None:
    assert backend_names() == ["cpu", "reference", "cuda"]
    offered = [fits_of(SimpleNamespace(backend=name)) for name in backend_names()]
    assert len({id(fits) for fits in offered}) == 3


def test_fused_terms_are_in_the_order_of_the_kernels_struct() -> None:
    for file, struct, table in (
        ("native/kernels.h", "LossWeights", PIXEL_TERMS),
        ("native/cuda/fit.cu", "LossWeights", PIXEL_TERMS),
        ("native/kernels.h", "StepOptions", SHAPE_TERMS),
    ):
        text = (PACKAGE / file).read_text(encoding="utf-8")
        found = re.search(rf"struct {struct} \{{ float ([\w, ]+);", text)
        assert found, f"{file} defines {struct}"
        assert tuple(found[1].split(", ")) == table


def test_fused_terms_are_loss_terms() -> None:
    assert set(losses.TERMS) >= FUSED_TERMS


def test_without_variance_planes_the_terms_that_need_them_weigh_nothing() -> None:
    weights = dict.fromkeys(PIXEL_TERMS, 0.5)
    assert pixel_weights(weights, variance=True).tolist() == [0.5] * len(PIXEL_TERMS)
    zero = [PIXEL_TERMS.index(name) for name in ("nll_color", "nll_depth")]
    found = pixel_weights(weights, variance=False)
    assert [k for k, weight in enumerate(found) if weight == 0.0] == zero
