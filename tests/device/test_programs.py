"""Compiled kernels are read back in the next process, and only where they are what was written."""

import shutil

import numpy as np
import pyopencl as cl
import pytest

from clsplat.device import Device, Kernel, each, programs
from clsplat.errors import DeviceError

SOURCE = """
__kernel void twice(uint count, __global const float *values, __global float *results)
{
    results[get_global_id(0)] = 2 * values[get_global_id(0)];
}
"""
TWICE = Kernel(
    "twice.cl", "twice", each("count"), count="uint", values=("float", "N"), results=("float", "N")
).forms.item
SWAPPED = Kernel(
    "swapped.cl", "twice", each("count"), count="uint", results=("float", "N"), values=("float", "N")
).forms.item


@pytest.fixture
def folder(float_device, tmp_path, monkeypatch):
    """Where binaries are kept: nothing yet."""
    monkeypatch.setattr(programs, "PLATFORMS", (float_device.handle.platform.name,))
    monkeypatch.setattr(programs.Path, "home", lambda: tmp_path)
    return tmp_path / ".cache" / "clsplat" / "kernels"


def build(device, source=SOURCE, options=("-cl-kernel-arg-info",), kernels=(TWICE,)):
    return programs.build(device.context, device.handle, source, list(options), kernels)


def was_compiled(program):
    return program.get_info(cl.program_info.SOURCE) != ""


def doubled(device, program):
    values, results = device.upload([1, 2.5]), device.empty(2)
    cl.Kernel(program, "twice")(device.queue, (2,), None, np.uint32(2), values.buffer, results.buffer)
    return results.download().tolist()


def test_a_binary_is_read_back(float_device, folder):
    assert was_compiled(build(float_device)) and len(list(folder.iterdir())) == 1
    again = build(float_device)
    assert not was_compiled(again) and doubled(float_device, again) == [2, 5]


def test_whatever_changes_the_program_compiles_again(float_device, folder, monkeypatch):
    build(float_device)
    assert was_compiled(build(float_device, SOURCE + "\n"))
    assert was_compiled(build(float_device, options=("-cl-kernel-arg-info", "-DX=1")))
    assert len(list(folder.iterdir())) == 3


@pytest.mark.parametrize("name", ["compact.cl", "item/compact.cl", "group/compact.cl", "include/group.h"])
def test_the_name_of_a_binary_covers_what_its_source_includes(float_device, folder, tmp_path, monkeypatch, name):
    def named():
        texts = [programs.kernel_source.__wrapped__(file) for file in ("compact.cl", "gather.cl")]
        return [programs._file_of(float_device.handle, text, [], []) for text in texts]

    copy = tmp_path / "cl"
    shutil.copytree(programs.kernel_folder(), copy)
    monkeypatch.setattr(programs, "kernel_folder", lambda: copy)
    before = named()
    with (copy / name).open("a") as file:
        file.write("// another line\n")
    after = named()
    assert after[0] != before[0] and after[1] == before[1]


@pytest.mark.parametrize(
    "damage",
    [lambda data: data[:-1], lambda data: b"", lambda data: data[40:], lambda data: data[:50] + b"x" + data[51:]],
)
def test_a_damaged_binary_is_not_used(float_device, folder, damage):
    build(float_device)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert was_compiled(build(float_device))
    assert not was_compiled(build(float_device)), "and it was replaced"


@pytest.mark.parametrize("times", [1, 2])
def test_a_wrong_declaration_is_refused_however_often(float_device, folder, tmp_path, times):
    (tmp_path / "twice.cl").write_text(SOURCE)
    names = str(tmp_path / "twice.cl")
    right, wrong = (Kernel(names, "twice", each("count"), **kernel.arguments) for kernel in (TWICE, SWAPPED))
    for _ in range(times):
        device = Device(float_device.handle, form=float_device.form)
        device._build(right, ())
        with pytest.raises(DeviceError, match="argument 1 is"):
            device._build(wrong, ())


def test_a_source_elsewhere_may_have_its_own_included_files(tmp_path):
    (tmp_path / "own.cl").write_text('#include "real.h"\n#include "own.h"\n')
    (tmp_path / "own.h").write_text("int own;\n")
    source = programs.kernel_source(str(tmp_path / "own.cl"))
    assert "int own;" in source and "typedef double real;" in source


def test_a_home_that_cannot_be_written_costs_nothing(float_device, tmp_path, monkeypatch, folder):
    (tmp_path / ".cache").write_text("not a folder")
    assert doubled(float_device, build(float_device)) == [2, 5]


def test_what_was_long_unused_is_removed(float_device, folder):
    build(float_device)
    (old,) = folder.iterdir()
    programs.os.utime(old, (1, 1))
    build(float_device, SOURCE + "\n")
    assert not old.exists() and len(list(folder.iterdir())) == 1
