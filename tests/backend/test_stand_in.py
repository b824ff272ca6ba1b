"""What stands in for a CUDA device keeps CUDA's rules: who may meet whom, who waits, what unwritten memory holds."""

import numpy as np
import pytest
import torch

from stand_in import DEVICE, RUBBISH, DeviceTensor, StandIn

MIXED = "all tensors to be on the same device"


def test_tensors_lie_where_they_say(stand_in: StandIn) -> None:
    x = torch.arange(6.0).reshape(2, 3).to("cuda")
    assert x.device == DEVICE and x.is_cuda and isinstance(x, DeviceTensor)
    for y in (x + 1, x.new_zeros(2), torch.zeros_like(x), x[0], x.sum(), x.split(1)[1], torch.ones(2, device="cuda")):
        assert y.device == DEVICE
    assert x.cpu().device.type == "cpu" and torch.equal(x.cpu(), torch.arange(6.0).reshape(2, 3))
    assert torch.arange(3).device.type == "cpu"


def test_host_and_device_do_not_mix(stand_in: StandIn) -> None:
    here, there = torch.ones(3), torch.ones(3, device="cuda")
    for mix in (
        lambda: here + there, lambda: there * here, lambda: torch.cat([here, there]), lambda: here.add_(there),
        lambda: torch.where(there > 0, here, 0.0), lambda: here[torch.tensor([0]).cuda()], lambda: here @ there,
        lambda: torch.tensor(1.0).add_(there.sum()), lambda: there.index_select(0, torch.tensor([1])),
        lambda: torch.cat([there.sum()[None], torch.zeros(1)]), lambda: torch.stack([there.sum(), torch.tensor(1.0)]),
        lambda: torch.searchsorted(there, here), lambda: torch.addcmul(there, there, here),
    ):  # fmt: skip
        with pytest.raises(RuntimeError, match=MIXED):
            mix()
    with pytest.raises(TypeError, match=r"Tensor\.cpu"):
        there.numpy()
    with pytest.raises(TypeError, match=r"Tensor\.cpu"):
        np.asarray(there)


def test_a_number_of_the_host_meets_the_device(stand_in: StandIn) -> None:
    there = torch.ones(3, device="cuda")
    assert (there * torch.tensor(2.0)).tolist() == [2.0] * 3
    assert (torch.zeros(()) + 3.0 * there.sum()).device == DEVICE
    there[1] = 5
    there[there > 4] = torch.tensor(7.0)
    assert there.tolist() == [1, 7, 1]


def test_inference_mode_changes_nothing(stand_in: StandIn) -> None:
    with torch.inference_mode():
        x = torch.ones(2, 3).to(torch.zeros(1, device="cuda"))
        assert x.reshape(3, 2).device == DEVICE and (x @ x.T).sum().item() == 12
        with pytest.raises(RuntimeError, match=MIXED):
            x @ torch.ones(3)


def test_views_and_writing_in_place(stand_in: StandIn) -> None:
    x = torch.zeros(3, 4, device="cuda")
    row, before = x[1], x
    row += 2
    x[:, 0].fill_(9)
    x -= 1
    assert x is before and x.tolist() == [[8, -1, -1, -1], [8, 1, 1, 1], [8, -1, -1, -1]]
    assert x.T.is_contiguous() is False and x[:, 1:].stride() == (4, 1) and x[1:].storage_offset() == 4


def test_autograd_goes_there_and_back(stand_in: StandIn) -> None:
    class Doubled(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):  # type: ignore[no-untyped-def]
            return x * 2

        @staticmethod
        def backward(ctx, g):  # type: ignore[no-untyped-def]
            assert g.device == DEVICE
            return g * 2

    here = torch.arange(3.0, requires_grad=True)
    (Doubled.apply(here.to("cuda")) ** 2).sum().backward()  # type: ignore[no-untyped-call]
    assert here.grad is not None and here.grad.device.type == "cpu" and here.grad.tolist() == [0, 8, 16]


@pytest.mark.parametrize(
    ("do", "waits"),
    [
        (lambda x: float(x.sum()), ["_local_scalar_dense"]),
        (lambda x: bool((x > 0).any()), ["_local_scalar_dense"]),
        (lambda x: x.cpu(), ["fetching"]),
        (lambda x: x.nonzero(), ["nonzero"]),
        (lambda x: x[x > 0], ["index by a mask"]),
        (lambda x: x.__setitem__(x > 0, x[:1].expand(3)), ["index_put by a mask"]),
        (lambda x: x.__setitem__(x > 0, 1.0), []),
        (lambda x: x[torch.tensor([0])], ["sending"]),
        (lambda x: x[x.argsort()], []),
        (lambda x: x.new_tensor([1.0, 2.0]), ["sending"]),
        (lambda x: torch.tensor([1.0], device=x.device), ["sending"]),
        (lambda x: torch.as_tensor(np.ones(2), device=x.device), ["sending"]),
        (lambda x: torch.as_tensor(x, device=x.device), []),
        (lambda x: x.tolist(), ["fetching"]),
        (lambda x: torch.where(x > 0, x, 0.0), []),
        (lambda x: torch.where(x > 0, x, torch.tensor(0.0)), ["sending"]),
        (lambda x: x.cumsum(0).sort().values.to(torch.float64).clamp(min=0.0), []),
        (lambda x: torch.cuda.synchronize(), ["synchronize"]),
    ],
)
def test_who_makes_the_host_wait_is_counted(stand_in: StandIn, do, waits) -> None:  # type: ignore[no-untyped-def]
    x = torch.tensor([3.0, 1.0, 2.0]).to("cuda")
    stand_in.forget()
    do(x)
    assert [reason for _, reason in stand_in.waits] == waits


def test_what_travels_alone_arrives_with_its_event(stand_in: StandIn) -> None:
    there, here = torch.tensor([5]).to("cuda"), torch.empty(1, dtype=torch.int64, pin_memory=True)
    stand_in.forget()
    here.copy_(there, non_blocking=True)
    arrived = torch.cuda.Event()
    arrived.record(torch.cuda.current_stream())
    assert int(here) == RUBBISH and stand_in.waits == [] and stand_in.copies[0].numbers == 1
    arrived.synchronize()
    assert int(here) == 5


def test_pinned_memory_may_not_change_while_it_travels(stand_in: StandIn) -> None:
    here, there = torch.ones(2).pin_memory(), torch.empty(2, device="cuda")
    there.copy_(here, non_blocking=True)
    here.zero_()
    with pytest.raises(AssertionError, match="on its way"):
        torch.cuda.synchronize()


def test_memory_that_nobody_wrote_is_rubbish(stand_in: StandIn) -> None:
    x = torch.ones(2, 3, device="cuda")
    assert torch.empty_like(x).isnan().all() and x.new_empty(4, dtype=torch.int32).tolist() == [RUBBISH] * 4


def test_kernels_take_memory_of_the_device_only(stand_in: StandIn) -> None:
    with pytest.raises(AssertionError, match="memory of the host"):
        stand_in.launch(4, "project_splats", 1, (torch.zeros(3), 4))
