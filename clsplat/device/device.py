"""An open device: context, queue, memory, built programs, checked launches, profiling."""

import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.tools
from numpy.typing import ArrayLike, DTypeLike

from clsplat.device.array import Arena, Array, Block
from clsplat.device.capabilities import probe_capabilities, probe_wave
from clsplat.device.graph import Graph
from clsplat.device.kernel import DEVICE_SIZES, SCALARS, Defines, Kernel
from clsplat.device.programs import build, define_options, kernel_source, words_of
from clsplat.device.tuning import tuning_of
from clsplat.errors import TOO_LARGE, DeviceError, OutOfDeviceMemory

SMALLEST_BYTES = 64  # of a buffer

Handle = cl.Device  # a device that is not open, for modules that do not import pyopencl
Shape = int | tuple[int, ...]
Program = tuple[str, Defines, int]  # a file, constants of its build, and its declared kernels


class Device:
    """One OpenCL device, opened in one precision and one preferred kernel form.

    Parameters
    ----------
    precision : "float", or "double" for tests.
    form : "item" (a work-item owns a tile or a chunk; CPUs), "group" (a work-group does; GPUs) or
        "auto", which chooses by the type of the device.
    profiling : whether `profile` can be used.
    build_options : further options of the OpenCL compiler.
    tuning : sizes as of `tuning_of`; None: those that it gives for what the device reports.

    Attributes
    ----------
    reported : by the device, of what decides its sizes.
    tuning : sizes as of `tuning_of`; the ones below are these, as far as the device allows.
    real : the type of floating-point numbers in this precision.
    tile : pixels, the width and height of a tile.
    wave : lanes that run in step, 32 or 64: the group form's pixels of a sub-tile.
    item_runs, group_size, scan_group, bucket : as for `tuning_of`.
    adjoint_group : lanes of a group of the blend adjoint, a multiple of `wave`.
    largest_buffer : bytes.
    memory_limit : bytes that arrays may take together; at first all memory of the device.
    peak_bytes : the largest value that `memory_bytes` had whenever an array was made.
    build_seconds : time for which launches waited for compilers so far.
    launches : kernels and fills that were enqueued so far.
    waits : how often the host waited for the device so far.
    allocations : arrays that were created so far, of new memory or old.
    """

    def __init__(
        self,
        handle: Handle,
        precision: str = "float",
        form: str = "auto",
        profiling: bool = False,
        build_options: Sequence[str] = (),
        tuning: Mapping[str, int] | None = None,
    ) -> None:
        self.handle = handle
        self.name = handle.name.strip()
        self.is_cpu = bool(handle.type & cl.device_type.CPU)
        self.form = ("item" if self.is_cpu else "group") if form == "auto" else form
        self.real = np.dtype(np.float64 if precision == "double" else np.float32)
        self.context = cl.Context([handle])
        properties: Any = cl.command_queue_properties.PROFILING_ENABLE if profiling else 0
        self.queue = cl.CommandQueue(self.context, handle, properties=properties)
        self.capabilities = probe_capabilities(self.context, handle)
        self.compute_units = handle.max_compute_units
        self.largest_buffer = handle.max_mem_alloc_size
        self.limit_memory()
        self.wave = probe_wave(self.context, handle)
        self.reported: dict[str, Any] = {
            "kind": "cpu" if self.is_cpu else "gpu",
            "wave": self.wave,
            "compute_units": self.compute_units,
            "local_bytes": handle.local_mem_size,
        }
        self.tuning = tuning = dict(tuning or tuning_of(**self.reported))
        most_items = handle.max_work_group_size
        self.item_runs, self.bucket = tuning["item_runs"], tuning["bucket"]
        self.group_size = min(tuning["group_size"], most_items)
        self.scan_group = min(tuning["scan_group"], 1 << most_items.bit_length() - 1)
        # a lane owns a pixel of a tile, which is smaller where groups are; the item form's is fixed
        self.tile = 16 if self.form == "item" else (tuning["tile"] if most_items >= tuning["tile"] ** 2 else 8)
        self.adjoint_group = min(tuning["adjoint_waves"] * self.wave, self.tile**2)
        # an immediate allocation fails now, and not at a launch
        immediate = cl.tools.ImmediateAllocator(self.queue)
        self._pool = Arena(lambda size: immediate(self._limited(size)))
        self._persistent_bytes = 0  # of the arrays that are still alive
        self.peak_bytes = 0
        self._kernels: dict[tuple[Kernel, Defines, Defines], cl.Kernel] = {}
        self._programs: dict[Program, Any] = {}
        self._ahead: dict[Program, Future[Any]] = {}  # programs that threads compile
        # built -> types of its scalar arguments, kernels like it that no recording uses
        self._spares: dict[cl.Kernel, tuple[list[Any], list[cl.Kernel]]] = {}
        self.build_seconds = 0.0
        self.launches = self.waits = self.allocations = 0
        self._recording: Graph | None = None
        self._profile: list[tuple[str, cl.Event]] | None = None
        self._dtypes = {**SCALARS, "real": self.real.type}
        self._base_options = [
            "-cl-std=CL1.2",
            "-cl-kernel-arg-info",
            f"-DREAL_IS_DOUBLE={int(precision == 'double')}",
            f"-DFORM_ITEM={int(self.form == 'item')}",
            *([] if precision == "double" else ["-cl-single-precision-constant"]),
            *(f"-D{name}=1" for name, has in self.capabilities.items() if has),
            *build_options,
        ]

    # --- memory

    @property
    def memory_bytes(self) -> int:
        """Device memory that persistent arrays and the blocks of short-lived ones use now."""
        return self._pool.managed_bytes + self._persistent_bytes

    def empty(self, shape: Shape, dtype: DTypeLike | None = None) -> Array:
        """An uninitialised short-lived Array; dtype None is the device's real type.

        Recordings need the same sizes again and again, so that their blocks are exact.
        """
        return self._new(shape, dtype, partial(self._pool.allocate, exact=self._recording is not None))

    def result(self, shape: Shape, dtype: DTypeLike | None = None) -> Array:
        """As `empty`, for what is read after a recording, whose memory no other launch may use."""
        if self._recording is None:
            return self.empty(shape, dtype)
        array = self.allocate(shape, dtype)
        self._recording.lasting.append(array)
        return array

    def zeros_once(self, shape: Shape, dtype: DTypeLike | None = None) -> Array:
        """As `result`, of zeros, for kernels that leave zeros there again: a recording does not
        record that they are set."""
        array = self.result(shape, dtype)
        self._filled(array, 0)
        return array

    def limit_memory(self, nbytes: int | None = None) -> None:
        """Let arrays take at most so many bytes together; None: all memory of the device."""
        has: int = self.handle.global_mem_size
        self.memory_limit = has if nbytes is None else min(nbytes, has)

    def trim(self) -> None:
        """Give back the memory that is kept for short-lived arrays and not in use."""
        self._pool.free_held()

    def allocate(self, shape: Shape, dtype: DTypeLike | None = None) -> Array:
        """An uninitialised persistent Array, of its exact size."""
        return self._new(shape, dtype, self._new_block)

    def _new(self, shape: Shape, dtype: DTypeLike | None, allocate: Callable[[int], Block]) -> Array:
        shape = tuple(map(int, shape)) if isinstance(shape, tuple) else (int(shape),)
        dtype = self.real if dtype is None else np.dtype(dtype)
        size = max(math.prod(shape) * dtype.itemsize, SMALLEST_BYTES)
        self.check_size(size)
        self.allocations += 1
        try:
            array = Array(self, allocate(size), shape, dtype)
        except (cl.MemoryError, cl.RuntimeError) as error:
            raise OutOfDeviceMemory(
                f"{self.name}: {TOO_LARGE}: no memory for {size >> 20} MiB more "
                f"({self.memory_bytes >> 20} MiB in use): use --max-gaussians or -r ({error})"
            ) from None
        self.peak_bytes = max(self.peak_bytes, self.memory_bytes)
        return array

    def _limited(self, size: int) -> int:
        """The size of a new buffer, for which there is room below the limit."""
        if self.memory_bytes + size > self.memory_limit:
            self.trim()
        if self.memory_bytes + size > self.memory_limit:
            raise OutOfDeviceMemory(
                f"{self.name}: {TOO_LARGE}: no memory for {size >> 20} MiB more "
                f"({self.memory_bytes >> 20} of {self.memory_limit >> 20} MiB in use): use a "
                "larger --memory-budget, --max-gaussians or -r"
            )
        return size

    def _new_block(self, size: int) -> Block:
        block = Block(cl.Buffer(self.context, cl.mem_flags.READ_WRITE, self._limited(size)), self._freed)
        self._persistent_bytes += size
        return block

    def _freed(self, buffer: cl.Buffer) -> None:
        self._persistent_bytes -= buffer.size

    def check_size(self, size: int) -> None:
        """Raise OutOfDeviceMemory for an array of `size` bytes, more than one buffer may have."""
        limit = self.largest_buffer
        if size > limit:
            raise OutOfDeviceMemory(
                f"{self.name}: {TOO_LARGE}: one buffer of {size >> 20} MiB is needed, the limit "
                f"is {limit >> 20} MiB; use --max-gaussians or -r"
            )

    def zeros(self, shape: Shape, dtype: DTypeLike | None = None) -> Array:
        """A persistent Array of zeros."""
        array = self.allocate(shape, dtype)
        array.fill(0)
        return array

    def upload(self, values: ArrayLike, dtype: DTypeLike | None = None) -> Array:
        """A persistent Array with a copy of host values; floats become the device's real type."""
        values = np.asarray(values)
        if dtype is None:
            dtype = self.real if values.dtype.kind == "f" else values.dtype
        array = self.allocate(values.shape, dtype)
        if values.size:
            self.note_wait()
            cl.enqueue_copy(self.queue, array.buffer, np.ascontiguousarray(values, dtype))
        return array

    def fill(self, array: Array, value: float) -> None:
        """Set every element of an array to `value`."""
        arguments = self._filled(array, value)
        if self._recording is not None:
            self._recording.add("fill", None, 0, 0, arguments)

    def _filled(self, array: Array, value: float) -> list[Any]:
        """Set every element of an array to `value`; returns the arguments of the fill."""
        arguments = [array.buffer, array.dtype.type(value), 0, array.nbytes]
        cl.enqueue_fill_buffer(self.queue, *arguments)
        self.launches += 1
        return arguments

    # --- launching

    def launch(self, kernel: Kernel, defines: Defines = (), /, **values: Any) -> None:
        """Run `kernel` over as many work-items as its contract says.

        Parameters
        ----------
        defines : constants of the build.
        values : the kernel's arguments by name, those of both forms and of all builds.
        """
        arguments, items, group = kernel.bind(self, values, defines)
        if not items:
            return
        built = self._build(kernel, defines)
        if self._recording is not None:
            self._recording.add(kernel.function, built, items, group, arguments)
        event = built(self.queue, (items,), (group,), *arguments)
        self.launches += 1
        if self._profile is not None:
            self._profile.append((kernel.function, event))

    @contextmanager
    def record(self, **inputs: Array | float) -> Iterator[Graph]:
        """Record all launches of the block, which run as well, for `Graph.replay`.

        Short-lived arrays of the block are only valid while a replay runs, except those of
        `result`, which live as long as the Array or the graph. The host must not wait
        for the device in the block.

        Parameters
        ----------
        inputs : arrays and numbers that a replay may replace. Launches of the block must use those
            of the graph's `inputs`, as they are.
        """
        graph = self._recording = Graph(self, inputs)
        try:
            yield graph
        finally:
            self._recording = None

    def note_wait(self) -> None:
        """Count that the host waits; RuntimeError while launches are recorded."""
        if self._recording is not None:
            raise RuntimeError("a recording must not wait for the device")
        self.waits += 1

    def _build(self, kernel: Kernel, defines: Defines) -> cl.Kernel:
        """The compiled kernel of this device's form and sizes, compiled once."""
        sizes = self._sizes()
        key = kernel, defines, sizes
        if key not in self._kernels:
            start = time.perf_counter()
            self._kernels[key] = self._built(kernel, sizes + defines)
            self.build_seconds += time.perf_counter() - start
        return self._kernels[key]

    def build_ahead(self, kernels: Iterable[tuple[Kernel, Defines]], threads: Executor) -> None:
        """Compile kernels with these constants in threads; a launch waits for its own, and compiles
        what was cancelled."""
        # from here on: `catch_warnings` does not hold in several threads
        warnings.simplefilter("ignore", cl.CompilerWarning)
        for kernel, defines in kernels:
            key, compiled = self._program(kernel, self._sizes() + defines)
            if key not in self._programs and key not in self._ahead:
                self._ahead[key] = threads.submit(compiled)

    def _sizes(self) -> Defines:
        return tuple((name, getattr(self, size)) for name, size in DEVICE_SIZES.items())

    def _program(self, kernel: Kernel, defines: Defines) -> tuple[Program, Callable[[], Any]]:
        """What the program of a kernel is known by, and what compiles it, in any thread."""
        file = kernel.file
        # without what the source does not name, which would compile the same program again
        defines = tuple((name, value) for name, value in defines if name in words_of(file))
        contracts = [other.contract(self, defines) for other in Kernel.declared[file] if other.forms.of(self)]
        return (file, defines, len(contracts)), partial(
            build,
            self.context,
            self.handle,
            kernel_source(file),
            self._base_options + define_options(defines),
            contracts,
        )

    def _built(self, kernel: Kernel, defines: Defines) -> cl.Kernel:
        file, contract = kernel.file, kernel.contract(self, defines)
        key, compiled = self._program(kernel, defines)
        if key not in self._programs:
            ahead = self._ahead.pop(key, None)
            try:
                with warnings.catch_warnings():  # runtimes warn of every successful build
                    warnings.simplefilter("ignore", cl.CompilerWarning)
                    self._programs[key] = compiled() if ahead is None or ahead.cancelled() else ahead.result()
            except cl.Error as error:
                raise DeviceError(f"{self.name}: {file} does not build:\n{error}") from None
        built = cl.Kernel(self._programs[key], kernel.function)
        contract.check_built(built)
        # the type of each argument that is a number, None for arrays
        scalars = [self._dtypes[a] if isinstance(a, str) else None for a in contract.arguments.values()]
        built.set_scalar_arg_dtypes(scalars)
        self._spares[built] = scalars, []
        return built

    def spare_kernel(self, built: cl.Kernel) -> tuple[cl.Kernel, list[cl.Kernel]]:
        """A kernel like `built` whose arguments a recording may keep, and the list to which to
        return it: to make one takes half a millisecond, as pyopencl writes and compiles code."""
        scalars, spare = self._spares[built]
        if spare:
            return spare.pop(), spare
        kernel = cl.Kernel(built.program, built.function_name)
        kernel.set_scalar_arg_dtypes(scalars)
        return kernel, spare

    def finish(self) -> None:
        """Wait for everything queued."""
        self.note_wait()
        self.queue.finish()

    @contextmanager
    def profile(self) -> Iterator[dict[str, list[float]]]:
        """Collect the seconds of each launch by kernel function, in a dict that is filled on exit."""
        if not self.queue.properties & cl.command_queue_properties.PROFILING_ENABLE:
            raise DeviceError(f"{self.name} was opened without profiling")
        launches: list[tuple[str, cl.Event]] = []
        self._profile = launches
        times: dict[str, list[float]] = {}
        try:
            yield times
            self.finish()
            for function, event in launches:
                seconds = (event.profile.end - event.profile.start) * 1e-9
                times.setdefault(function, []).append(seconds)
        finally:
            self._profile = None
