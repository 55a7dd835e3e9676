"""Opens the OpenCL devices of the tests: each platform in both kernel forms and both precisions.

A test asks for `device` (all four), `float_device`, `double_device` (both forms) or `group_device`;
where it takes both precisions, the double ones are nightly, and slow tests where it is marked
`double`.
CLSPLAT_TEST_DEVICES chooses the platforms: unset, PoCL, else the first that works; a part of a
platform's or device's name; or "all". A device is opened once and shared, so whatever a test
changes of it, it changes with monkeypatch.
"""

import functools
import gc
import os
from collections import Counter

import pytest
from filelock import FileLock

from tests.shared_kernels import SharedKernels

WORKER = os.environ.get("PYTEST_XDIST_WORKER")
KERNELS = SharedKernels(WORKER) if WORKER else None

from clsplat.device import Device, choose_device, list_devices  # noqa: E402  (reads the environment above)
from tests.shared_programs import share  # noqa: E402

share()

FORMS, PRECISIONS = ("item", "group"), ("float", "double")
FIXTURES = {  # name -> the forms and precisions it stands for
    "device": (FORMS, PRECISIONS),
    "float_device": (FORMS, ("float",)),
    "double_device": (FORMS, ("double",)),
    "group_device": (("group",), PRECISIONS),
}
POCL, SIMULATOR = "Portable Computing Language", "Oclgrind"


def pytest_generate_tests(metafunc):
    for name, (forms, precisions) in FIXTURES.items():
        if name in metafunc.fixturenames:
            combinations = [
                (entry, form, precision)
                for entry in _entries()
                for form in forms
                for precision in precisions
                if _is_worth_it(entry, precision)
            ]
            marks = [pytest.mark.slow]  # float is quick to tell of a fault
            if not metafunc.definition.get_closest_marker("double"):
                marks.append(pytest.mark.nightly)
            metafunc.parametrize(
                name,
                [
                    pytest.param(each, marks=marks if each[2:] == precisions[1:] else (), id=_label(each))
                    for each in combinations
                ],
                indirect=True,
            )


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items):
    """Of a test marked one_in(k), every k-th case runs for each change, of those that are slow as
    well, and all of them each night."""
    cases = Counter()
    for item in items:
        marker = item.get_closest_marker("one_in")
        if marker and not item.get_closest_marker("nightly"):
            kind = item.function, item.get_closest_marker("slow") is None
            if cases[kind] % marker.args[0]:
                item.add_marker("nightly")
            cases[kind] += 1


def pytest_collection_finish():
    gc.collect()
    gc.freeze()  # or each collection of garbage would look at all tests


@pytest.fixture(scope="module", autouse=True)
def kernels_of_all_workers():
    if KERNELS:
        KERNELS.exchange()


def pytest_sessionfinish():
    if KERNELS:
        KERNELS.exchange(at_once=True)


def _is_worth_it(entry, precision):
    """The simulator is slow; races and accesses out of bounds do not depend on the precision."""
    return isinstance(entry, str) or SIMULATOR not in entry.platform or precision == "float"


@functools.cache
def _entries():
    """The devices to test, as `ListedDevice`, or a sentence that says why there is none."""
    wanted = os.environ.get("CLSPLAT_TEST_DEVICES", "")
    entries = list_devices()
    working = [entry for entry in entries if entry.works]
    pocl = [entry for entry in working if entry.platform == POCL]
    if wanted == "all":
        return entries or ("no OpenCL platform is installed",)
    if wanted:
        return tuple(entry for entry in working if wanted.lower() in f"{entry.platform} {entry.name}".lower()) or (
            f"no working device matches CLSPLAT_TEST_DEVICES={wanted}",
        )
    if pocl or working and not _is_ci():
        return (pocl or working)[:1]
    reasons = [f"{entry.platform} {entry.name}: {entry.reason}" for entry in entries]
    return (f"no working PoCL ({'; '.join(reasons) or 'no OpenCL platform'})",)


def _is_ci():
    return os.environ.get("CI") == "true"


def _label(combination):
    entry, form, precision = combination
    name = "none" if isinstance(entry, str) else f"{entry.index}-{entry.platform.split()[0]}"
    return f"{name}-{form}-{precision}"


@pytest.fixture(scope="session")
def opened():
    """Devices opened so far, so that each kernel is built once."""
    return {}


def _open(request, opened):
    entry, form, precision = request.param
    if isinstance(entry, str):
        (pytest.fail if _is_ci() or os.environ.get("CLSPLAT_TEST_DEVICES") else pytest.skip)(entry)
    if not entry.works:
        pytest.skip(f"{entry.platform} {entry.name}: {entry.reason}")
    if precision == "double" and not entry.capabilities["HAVE_DOUBLE"]:
        pytest.skip(f"{entry.platform} {entry.name} has no double precision")
    key = entry.index, form, precision
    if key not in opened:
        opened[key] = Device(entry.handle, precision=precision, form=form)
        if SIMULATOR in entry.platform:
            opened[key]._pool = ExactBuffers(opened[key].context)
    return opened[key]


class ExactBuffers:
    """In place of a device's pool, whose buffers are larger than asked for: an access out of bounds
    would hide in the rest."""

    managed_bytes = 0  # it keeps none

    def __init__(self, context):
        self.context = context

    def allocate(self, size, exact=False):
        import pyopencl as cl  # clsplat.device must be the first to import it

        from clsplat.device.array import Block

        return Block(cl.Buffer(self.context, cl.mem_flags.READ_WRITE, size), lambda buffer: None)


@pytest.fixture(scope="session")
def city():
    """The scene of data_samples/city, read."""
    from clsplat.io.scenes.read import read_scene
    from tests.data.tiny_training import CITY

    return read_scene(CITY)


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """once(name, make): the folder that `make(folder)` has filled, in one worker for all of them;
    not to be changed."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if WORKER else root

    def made(name, make):
        with FileLock(root / f"{name}.lock"):
            if not (root / f"{name}.done").exists():
                make(root / name)
                (root / f"{name}.done").touch()
        return root / name

    return made


@pytest.fixture(scope="session")
def levelled(once, item_device, city):
    """The run of a training of the whole method, for all that only read one."""
    from clsplat.io.runs.run import RunFolder
    from tests.data.tiny_training import LEVELLED, trained

    return RunFolder.open(once("levelled", lambda folder: trained(folder, city, item_device, **LEVELLED)))


@pytest.fixture(scope="session")
def eventful(once, item_device, city):
    """The same of a training with the options EVENTFUL, and an evaluation every 50 steps."""
    from clsplat.io.runs.run import RunFolder
    from tests.data.tiny_training import trained

    return RunFolder.open(once("eventful", lambda folder: trained(folder, city, item_device, eval_every=50)))


@pytest.fixture
def device(request, opened):
    return _open(request, opened)


@pytest.fixture(scope="session")
def item_device():
    """Where neither form nor precision matters: the device that users get, in its quicker form."""
    wanted = os.environ.get("CLSPLAT_TEST_DEVICES", "all")
    return choose_device("auto" if wanted == "all" else wanted, form="item")


@pytest.fixture
def float_device(request, opened):
    return _open(request, opened)


@pytest.fixture
def double_device(request, opened):
    return _open(request, opened)


@pytest.fixture
def group_device(request, opened):
    return _open(request, opened)
