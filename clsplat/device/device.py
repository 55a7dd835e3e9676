"""An open device: context, queue, memory, built programs, checked launches, profiling."""

import math
import time
import warnings
import weakref
from contextlib import contextmanager

import numpy as np
import pyopencl as cl
import pyopencl.tools

from clsplat.constants import LANES
from clsplat.device import binaries
from clsplat.device.array import Array
from clsplat.device.capabilities import probe_capabilities
from clsplat.device.kernel import DEVICE_SIZES, SCALARS, Kernel
from clsplat.device.runtimes import ignore_file_limits
from clsplat.device.source import defines as defined
from clsplat.device.source import kernel_source
from clsplat.errors import TOO_LARGE, DeviceError

SMALLEST_BYTES = 64  # of a buffer


class Device:
    """One OpenCL device, opened in one precision and one preferred kernel form.

    precision: "float", or "double" for tests. form: "item" (a work-item owns a tile or a chunk;
    CPUs) or "group" (a work-group does; GPUs); "auto" goes by the device's type. build_options: of
    the compiler, more than ours.
    """

    def __init__(self, handle, precision="float", form="auto", profiling=False,
                 build_options=()):
        self.handle = handle
        self.name = handle.name.strip()
        self.is_cpu = bool(handle.type & cl.device_type.CPU)
        self.form = ("item" if self.is_cpu else "group") if form == "auto" else form
        self.real = np.dtype(np.float64 if precision == "double" else np.float32)
        self.context = cl.Context([handle])
        properties = cl.command_queue_properties.PROFILING_ENABLE if profiling else 0
        self.queue = cl.CommandQueue(self.context, handle, properties=properties)
        self.capabilities = probe_capabilities(self.context, handle)
        ignore_file_limits()
        self.compute_units = handle.max_compute_units
        self.largest_buffer = handle.max_mem_alloc_size  # bytes
        self.group_size = min(128, handle.max_work_group_size)
        # a group owns a 16 x 16 tile, or 8 x 8 where groups are small; the item form's rows are 16
        self.tile = 16 if self.form == "item" or handle.max_work_group_size >= 256 else 8
        self.scan_group = min(LANES, 1 << handle.max_work_group_size.bit_length() - 1)
        # sizes change from view to view: coarse bins (two an octave) are reused, fine ones pile up
        self._pool = cl.tools.MemoryPool(
            cl.tools.ImmediateAllocator(self.queue), leading_bits_in_bin_id=1)
        self._held = Held()
        self.peak_bytes = 0  # the most that `memory_bytes` was, as seen by it and by `hold`
        self._kernels = {}
        self._programs = {}
        self.build_seconds = 0.0  # spent on compiling so far
        self.kernel_bytes = 0  # of the arrays given to kernels so far, once a launch
        self._profile = None
        self._dtypes = {**SCALARS, "real": self.real.type}
        self._base_options = [
            "-cl-std=CL1.2", "-cl-kernel-arg-info",
            f"-DREAL_IS_DOUBLE={int(precision == 'double')}",
            f"-DFORM_ITEM={int(self.form == 'item')}",
            *([] if precision == "double" else ["-cl-single-precision-constant"]),
            *(f"-D{name}=1" for name, has in self.capabilities.items() if has), *build_options]

    # --- memory

    @property
    def memory_bytes(self):
        """Device memory now held by long-lived arrays and by the pool of short-lived ones."""
        held = self._pool.managed_bytes + self._held.nbytes
        self.peak_bytes = max(self.peak_bytes, held)
        return held

    def empty(self, shape, dtype=None):
        """Uninitialised Array for a step's work, from the pool; dtype None is the device's real."""
        return self._allocate(shape, dtype, self._pool.allocate)

    def trim(self):
        """Give back what the pool keeps for arrays of sizes that are no longer asked for."""
        self._pool.free_held()

    def hold(self, shape, dtype=None):
        """Uninitialised Array that lives long: as large as it must be, and not from the pool."""
        array = self._allocate(
            shape, dtype, lambda size: cl.Buffer(self.context, cl.mem_flags.READ_WRITE, size))
        self._held.add(array)
        self.peak_bytes = max(self.peak_bytes, self.memory_bytes)
        return array

    def _allocate(self, shape, dtype, allocate):
        shape = tuple(map(int, shape)) if isinstance(shape, tuple) else (int(shape),)
        dtype = self.real if dtype is None else np.dtype(dtype)
        size = max(math.prod(shape) * dtype.itemsize, SMALLEST_BYTES)
        self.check_size(size)
        try:
            return Array(self, allocate(size), shape, dtype)
        except (cl.MemoryError, cl.RuntimeError) as error:
            raise DeviceError(
                f"{self.name}: {TOO_LARGE}: no memory for {size >> 20} MiB more "
                f"({self.memory_bytes >> 20} MiB held): use --max-gaussians or -r ({error})"
            ) from None

    def check_size(self, size):
        """Raise DeviceError for an array of more bytes than one buffer may have."""
        limit = self.largest_buffer
        if size > limit:
            raise DeviceError(
                f"{self.name}: {TOO_LARGE}: one buffer of {size >> 20} MiB is asked for, the limit "
                f"is {limit >> 20} MiB; use --max-gaussians or -r")

    def zeros(self, shape, dtype=None):
        """A long-lived Array of zeros."""
        array = self.hold(shape, dtype)
        array.fill(0)
        return array

    def upload(self, values, dtype=None):
        """A long-lived Array with a copy of host values; floats become the device's real."""
        values = np.asarray(values)
        if dtype is None:
            dtype = self.real if values.dtype.kind == "f" else values.dtype
        array = self.hold(values.shape, dtype)
        if values.size:
            cl.enqueue_copy(self.queue, array.buffer, np.ascontiguousarray(values, dtype))
        return array

    # --- launching

    def launch(self, kernel, defines=(), /, **values):
        """Run `kernel`, over as many work-items as its contract says.

        defines: ((name, value), ...) build-time constants; values: the kernel's arguments by name,
        those of both forms.
        """
        call = kernel.bind(self, values)
        if not call.items:
            return
        self.kernel_bytes += call.nbytes
        built = self._build(kernel, defines)
        event = built(self.queue, (call.items,), (call.group,), *call.arguments)
        if self._profile is not None:
            self._profile.append((kernel.function, event))

    def _build(self, kernel, defines):
        """The compiled kernel of this device's form and sizes, compiled once."""
        key = kernel, defines, self.tile, self.scan_group
        if key not in self._kernels:
            sizes = tuple((name, getattr(self, size)) for name, size in DEVICE_SIZES.items())
            self._kernels[key] = self._built(kernel.file, kernel.forms.of(self), sizes + defines)
        return self._kernels[key]

    def _built(self, file, kernel, defines):
        begin = time.perf_counter()
        program, checked = self._programs.get((file, defines), (None, None))
        if program is None or checked is not None and kernel.signature not in checked:
            options = self._base_options + defined(defines)
            try:
                with warnings.catch_warnings():  # runtimes chatter about every successful build
                    warnings.simplefilter("ignore", cl.CompilerWarning)
                    program, checked = binaries.build(
                        self.context, self.handle, kernel_source(file), options, kernel,
                        [other.forms.of(self) for other in Kernel.declared[file]])
            except cl.Error as error:
                raise DeviceError(f"{self.name}: {file} does not build:\n{error}") from None
            self._programs[file, defines] = program, checked
        built = cl.Kernel(program, kernel.function)
        kernel.check_built(built)
        built.set_scalar_arg_dtypes(
            [self._dtypes[a] if isinstance(a, str) else None for a in kernel.arguments.values()])
        self.build_seconds += time.perf_counter() - begin
        return built

    def finish(self):
        """Wait for everything queued."""
        self.queue.finish()

    @contextmanager
    def profile(self):
        """Collect event times: yields a dict, filled on exit, kernel function -> [seconds, ...]."""
        if not self.queue.properties & cl.command_queue_properties.PROFILING_ENABLE:
            raise DeviceError(f"{self.name} was opened without profiling")
        self._profile, times = [], {}
        try:
            yield times
            self.finish()
            for function, event in self._profile:
                seconds = (event.profile.end - event.profile.start) * 1e-9
                times.setdefault(function, []).append(seconds)
        finally:
            self._profile = None


class Held:
    """nbytes: of the arrays added that are still alive; kept up to date, as there may be thousands.
    """

    def __init__(self):
        self.nbytes = 0

    def add(self, array):
        self.nbytes += array.nbytes
        weakref.finalize(array, self._drop, array.nbytes).atexit = False

    def _drop(self, nbytes):
        self.nbytes -= nbytes
