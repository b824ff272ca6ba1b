"""Hold the fused CUDA mapping step, emulated, to its definitions in torch, float64."""

from pathlib import Path
from traceback import extract_stack
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from emulated_cuda import Emulator
from sigmasplat.fit.cuda.mapping_step import CudaStep
from sigmasplat.fit.mapping_step import TorchStep
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.render.cuda.view import CudaView
from splat_fields import OPTIONS, crowd, exact_view, params_of
from splat_scenes import SMALL, WIDE, assert_same_vector, scene
from test_compiled_loss import RATES, TERMS, WEIGHTS, draw_planes, fields, random_gradient, target_of
from test_cuda_view import CPU

Reads = list[tuple[str, str]]

SIZES = (SMALL, WIDE, Camera(33, 17, 30.0, 30.0, 15.5, 8.2), Camera(16, 16, 20.0, 20.0, 7.5, 7.5))


pytestmark = pytest.mark.usefixtures("on_the_cpu")


def planes_of(view: CudaView | SimpleNamespace) -> Tensor:
    return torch.cat([view.g_sums, view.g_median_depth[None], view.g_moment[None]]).clone()


def both_ways(
    camera: Camera, weights: dict[str, float], variance: bool, valid_share: float = 0.8
) -> tuple[tuple[float, Tensor], tuple[float, Tensor]]:
    """Evaluate fused and by definition: (loss, gradient planes) of each."""
    view = CudaView(camera, OPTIONS, variance, CPU)
    target = target_of(camera, (camera.height, camera.width), valid_share)
    draw_planes(view, target)  # type: ignore[arg-type]
    exact = SimpleNamespace(
        sums=view.sums.double(), g_sums=torch.zeros_like(view.sums).double(), moment=view.moment.double(),
        layers=SimpleNamespace(median_depth=view.layers.median_depth.double()),
        g_moment=torch.zeros_like(view.moment).double(), g_median_depth=torch.zeros_like(view.moment).double(),
    )  # fmt: skip
    for plane, name in ((view.g_sums, ""), (view.g_median_depth, "median_depth"), (view.g_moment, "moment")):
        plane.fill_(torch.nan if weights.get(name, 1.0) else 0.0)  # whatever was there must go
    got, want = CudaStep(view).images(target, weights), TorchStep(exact).images(target, weights)  # type: ignore[arg-type]
    return (float(got), planes_of(view)), (want, planes_of(exact))


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("camera", SIZES, ids=lambda c: f"{c.width}x{c.height}")
def test_whole_loss_and_its_gradient(camera: Camera, variance: bool) -> None:
    (got, gradient), (want, want_gradient) = both_ways(camera, WEIGHTS, variance)
    assert got == pytest.approx(want, rel=1e-5)
    for plane in range(len(gradient)):
        assert_same_vector(gradient[plane], want_gradient[plane], what=f"plane {plane}")


@pytest.mark.parametrize("name", TERMS)
def test_each_term_alone(name: str) -> None:
    weights = dict.fromkeys(WEIGHTS, 0.0) | {name: 0.7}
    (got, gradient), (want, want_gradient) = both_ways(WIDE, weights, True)
    assert got == pytest.approx(want, rel=1e-5) and abs(got) > 1e-3
    assert_same_vector(gradient, want_gradient, what=name)
    holes = target_of(WIDE, (WIDE.height, WIDE.width)).depth == 0
    assert int(holes.sum()) > 50 and torch.count_nonzero(gradient[:, holes]) == 0


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
def test_no_valid_pixel_costs_nothing(variance: bool) -> None:
    (got, gradient), (want, _) = both_ways(WIDE, WEIGHTS, variance, valid_share=0.0)
    assert got == pytest.approx(0.0, abs=1e-6) and want == pytest.approx(0.0, abs=1e-6)
    assert torch.count_nonzero(gradient) == 0


@pytest.mark.parametrize("n", [0, 7, 700])
def test_a_step_follows_its_definition(n: int) -> None:
    """Rows, moments, twist and shape terms over three steps, with splats out of view and rows that come back to it."""
    s, terms = crowd(), {"isotropy": 0.7, "isotropy_ratio": 0.01}
    (got, want), frozen = fields(n), n // 3
    start, exact, view = want.params.clone(), exact_view(s.camera, True), CudaView(s.camera, OPTIONS, True, CPU)
    left, right = (se3.exp(np.array([0, 0, 0, 0, turn, 0])) @ s.T_camera_world.numpy() for turn in (0.7, -0.5))
    for step, T in enumerate((left, right, left)):
        results = []
        for field, v, mapping in ((got, view, CudaStep(view)), (want, exact, TorchStep(exact))):
            field.steps += 1
            v.forward(field.params, T)
            random_gradient(v, step)  # type: ignore[arg-type]
            results.append(mapping.splats(field, RATES, terms, frozen))
        (twist, cost), (want_twist, want_cost) = results
        assert cost == pytest.approx(want_cost, rel=1e-4)
        assert torch.equal(got.last_step, want.last_step)
        if n:
            assert_same_vector(torch.as_tensor(twist), torch.as_tensor(want_twist), 1e-3, "twist")
    if n:
        assert_same_vector(got.moment1, want.moment1, 1e-3, "moment1")
        assert_same_vector(got.moment2, want.moment2, 1e-3, "moment2")
        assert_same_vector(got.params - start, want.params - start, 5e-3, "steps")
        assert torch.equal(got.params[:, 5], start[:, 5].float()), "a rate of 0 freezes a column"
    if n > 100:
        unseen = want.last_step < 100
        assert 5 < unseen.sum() < n and torch.equal(got.params[unseen], start[unseen].float())


@pytest.mark.parametrize("order", [1, 2, 3], ids=["warp by warp", "backwards", "shuffled"])
def test_the_order_of_threads_between_barriers_means_nothing(on_the_cpu: Emulator, order: int) -> None:
    (loss, want), _ = both_ways(WIDE, WEIGHTS, True)
    on_the_cpu.order = order
    (again, got), _ = both_ways(WIDE, WEIGHTS, True)
    assert loss == again and torch.equal(got, want)


WAITS = {
    Tensor.item, Tensor.tolist, Tensor.numpy, Tensor.cpu, Tensor.nonzero, Tensor.__float__, Tensor.__int__,
    Tensor.__bool__, Tensor.__array__,
}  # fmt: skip
"""What makes the host wait for a tensor of a device."""


OF_THE_HOST = [("raster.py", "__int__"), ("rows.py", "numpy")]
"""The number of pairs, which had arrived; Adam's rates."""


class Watch(TorchFunctionMode):
    """Note where a tensor is read by the host."""

    def __init__(self) -> None:
        super().__init__()
        self.reads: Reads = []

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function in WAITS:
            reader = next(x for x in reversed(extract_stack()) if "sigmasplat" in x.filename)
            self.reads.append((Path(reader.filename).name, function.__name__))
        return function(*args, **(kwargs or {}))


def test_the_host_waits_for_no_part_of_an_iteration() -> None:
    s = scene("random", 60)
    field, view = fields(60)[0], CudaView(s.camera, OPTIONS, True, CPU)
    field.params.copy_(params_of(s))
    target, step = target_of(s.camera, (s.camera.height, s.camera.width)), CudaStep(view)
    T = s.T_camera_world.double().numpy()
    view.forward(field.params, T)  # says how many pairs to expect
    with Watch() as watch:
        field.steps += 1
        step.forward(field, T, target, WEIGHTS)
        assert watch.reads == []
        loss = step.images(target, WEIGHTS)
        assert watch.reads == []
        step.splats(field, RATES, WEIGHTS, 3)
    assert watch.reads == OF_THE_HOST and float(loss) > 0
