"""Launches that are recorded and replayed do what direct ones do."""

import gc
import math

import numpy as np
import pytest

from clsplat.device import Device
from clsplat.device import graph as graph_module
from clsplat.device.graph import _ENQUEUE, Input
from clsplat.errors import ShapeError
from clsplat.loss.reproject import SCALE
from clsplat.primitives.gather import gather
from clsplat.primitives.reduce import add_to, sum_columns


@pytest.fixture
def own_device(item_device):
    """A device whose arena and counters nothing else has used."""
    return Device(item_device.handle, form="item")


def work(device, rows, indices, total, weight):
    """Kernels and a fill, with short-lived arrays between them: the sums that come of it."""
    picked = gather(device, rows, indices)
    extra = device.empty(picked.shape)
    extra.fill(0.5)
    add_to(device, picked, extra)
    add_to(device, total, picked)
    spare = device.empty(total.shape)
    spare.fill(0)
    device.launch(
        SCALE,
        count=total.shape[0] * total.shape[1],
        weight=weight,
        sums=device.ones,
        grad_depth=total,
        grad_transmittance=spare,
    )
    return sum_columns(device, total)


class Case:
    """Arrays for `work`, other ones for each `seed`."""

    def __init__(self, device, seed, rows=7):
        rng = np.random.default_rng(seed)
        device.ones = device.upload(np.ones(2))
        self.rows = device.upload(rng.normal(size=(rows, 3)))
        self.indices = device.upload(rng.permutation(7)[:5].astype(np.uint32))
        self.weight = float(rng.random())


def sums_of(device, replays):
    """The sums after each of five steps, which change `total`."""
    total, found = device.zeros((5, 3)), []
    graph = None
    for seed in range(5):
        case = Case(device, seed)
        inputs = dict(rows=case.rows, indices=case.indices, weight=case.weight)
        if not replays:
            found.append(work(device, total=total, **inputs).download())
        elif graph is None:
            with device.record(**inputs) as graph:
                graph.result = work(device, total=total, **graph.inputs)
            found.append(graph.result.download())
        else:
            graph.replay(**inputs)
            found.append(graph.result.download())
    return np.array(found), graph


@pytest.mark.parametrize("has_enqueue", [True, False])
def test_a_replay_does_what_direct_launches_do(own_device, monkeypatch, has_enqueue):
    """With other arrays and numbers in each, upon a state that each changes."""
    monkeypatch.setattr(graph_module, "_ENQUEUE", _ENQUEUE if has_enqueue else None)
    direct, _ = sums_of(own_device, False)
    replayed, graph = sums_of(own_device, True)
    assert np.array_equal(direct, replayed)
    assert len(np.unique(direct[:, 0])) == 5
    assert [function for function, *_ in graph._commands] == [
        "gather",
        "fill",
        "add_to",
        "add_to",
        "fill",
        "scale_gradients",
        "sum_columns",
    ]


def test_inputs_that_are_left_out_stay(own_device):
    device, case = own_device, Case(own_device, 0)
    total = device.zeros((5, 3))
    with device.record(rows=case.rows, weight=1.0) as graph:
        graph.result = work(device, case.rows, case.indices, total, graph.inputs["weight"])
    once = graph.result.download()
    other = Case(device, 1)
    graph.replay(rows=other.rows)
    graph.replay()
    expected = once.copy()
    for _ in range(2):
        expected += other.rows.download()[case.indices.download()].sum(0) + 2.5
    assert np.allclose(graph.result.download(), expected, rtol=1e-5)
    total.fill(0)
    graph.replay(rows=case.rows, weight=0.25)
    assert np.allclose(graph.result.download(), once / 4, rtol=1e-5)


def test_counters_of_a_replay(own_device):
    _, graph = sums_of(own_device, True)
    before = own_device.launches, own_device.waits, own_device.allocations
    graph.replay()
    assert own_device.launches - before[0] == len(graph._commands)
    assert (own_device.waits, own_device.allocations) == before[1:]


@pytest.mark.parametrize("wrong", ["shape", "type", "kind"])
def test_an_array_of_another_shape_is_refused(own_device, wrong):
    device, graph = own_device, sums_of(own_device, True)[1]
    other = {
        "shape": dict(rows=Case(device, 0, rows=8).rows),
        "type": dict(rows=device.zeros((7, 3), np.uint32)),
        "kind": dict(weight=device.zeros(1)),
    }[wrong]
    with pytest.raises(ShapeError, match="'(rows|weight)' has another shape or type"):
        graph.replay(**other)


@pytest.mark.parametrize(
    "wait",
    [
        lambda array: array.download(),
        lambda array: array.write([0.0]),
        lambda array: array.device.finish(),
        lambda array: array.device.upload(np.zeros(3)),
    ],
    ids=["download", "write", "finish", "upload"],
)
def test_a_recording_does_not_wait(own_device, wait):
    array = own_device.zeros(3)
    with pytest.raises(RuntimeError, match="must not wait"), own_device.record():
        wait(array)
    wait(array)  # afterwards it may


USES = {
    "+": lambda x: x + 1,
    "r*": lambda x: 2 * x,
    "neg": lambda x: -x,
    "round": round,
    "int": int,
    "bool": bool,
    "not": lambda x: not x,
    "<": lambda x: x < 1,
    "==": lambda x: x == 1,
    "r==": lambda x: 1 == x,
    "!=": lambda x: x != 1,
    "max": lambda x: max(1, x),
    "index": lambda x: [1, 2][x],
    "range": range,
    "unpacking": lambda x: [*x],
    "in": lambda x: x in (1, 2),
    "set": lambda x: {x},
    "str": str,
    "f-string": lambda x: f"{x}",
    "format": lambda x: f"{x:.2f}",
    "%s": lambda x: "%s" % (x,),
    "sqrt": math.sqrt,
    "numpy": np.float32,
    "array": np.asarray,
    "array sum": lambda x: np.ones(2) + x,
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("number", [2.0, 2], ids=["float", "int"])
def test_a_number_that_is_replaced_refuses_every_use_by_python(number, use):
    with pytest.raises(TypeError):
        USES[use](Input("weight", number))


def test_blocks_are_used_again_and_results_are_not(own_device):
    """A recording's short-lived arrays may be those of the next; its results live on."""
    device, graphs, results = own_device, [], []
    case, total = Case(device, 0), device.zeros((5, 3))
    with device.record(rows=case.rows) as graph:
        work(device, case.rows, case.indices, total, 1.0)
    del graph
    gc.collect()
    managed, persistent = device._pool.managed_bytes, device._persistent_bytes
    for _ in range(4):
        with device.record(rows=case.rows) as graph:
            graph.result = work(device, case.rows, case.indices, total, 1.0)
        graphs.append(graph)
        results.append(graph.result.download())
    assert device._pool.managed_bytes == managed
    assert device._persistent_bytes == persistent + 4 * graph.result.buffer.size
    assert len({id(graph.result.buffer) for graph in graphs}) == 4
    for graph, before in zip(graphs, results):  # none has overwritten another's
        assert np.array_equal(graph.result.download(), before)
    assert len({tuple(values) for values in results}) == 4
    del graph, graphs
    gc.collect()
    assert device._persistent_bytes == persistent
