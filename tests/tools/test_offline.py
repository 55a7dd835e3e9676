"""The table of what compilers say of the kernels: reading their words, and comparing with it."""

import json

import pytest

from clsplat.errors import InputError
from tools.offline import __main__ as offline
from tools.offline.compilers import (
    TARGETS,
    Usage,
    missing,
    nvidia_waves,
    parse_amd,
    parse_intel,
    parse_nvidia,
    sizes_of,
)

AMD = """
program.cl:194:0: remark: Function Name: blend_adjoint [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     TotalSGPRs: 40 [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     VGPRs: 90 [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     AGPRs: 6 [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     ScratchSize [bytes/lane]: 8 [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     Dynamic Stack: False [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     Occupancy [waves/SIMD]: 2 [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     SGPRs Spill: 14 [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     VGPRs Spill: 3 [-Rpass-analysis=kernel-resource-usage]
program.cl:194:0: remark:     LDS Size [bytes/block]: 10752 [-Rpass-analysis=kernel-resource-usage]
"""
NVIDIA = """
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'blend_adjoint' for 'sm_70'
ptxas info    : Function properties for blend_adjoint
    16 bytes stack frame, 12 bytes spill stores, 8 bytes spill loads
ptxas info    : Used 140 registers, used 1 barriers, 7716 bytes smem, 504 bytes cmem[0]
ptxas info    : Compile time = 100.675 ms
ptxas info    : Function properties for __clang_ocl_kern_imp_blend_adjoint
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Compiling entry function 'rows' for 'sm_70'
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 20 registers, used 0 barriers, 504 bytes cmem[0]
"""


INTEL = """---
version:         '1.73'
kernels:
  - name:            blend
    execution_env:
      grf_count:       128
      simd_size:       32
      slm_size:        12832
    payload_arguments:
      - arg_type:        arg_bypointer
        size:            8
  - name:            sweep
    execution_env:
      grf_count:       256
      simd_size:       16
      private_size:    3264
      spill_size:      2048
    per_thread_memory_buffers:
      - type:            scratch
        size:            8192
kernels_misc_info:
  - name:            blend
"""


def test_what_clang_says_for_amd():
    assert parse_amd(AMD, 64, {"blend_adjoint": 128}) == [Usage("blend_adjoint", 96, 40, 3, 14, 8, 10752, 2)]


def test_small_groups_that_share_local_memory_are_fewer_waves_than_clang_says():
    said = AMD.replace("[waves/SIMD]: 2", "[waves/SIMD]: 8")
    waves = [
        parse_amd(said, wave, {"blend_adjoint": group})[0].waves
        for wave, group in ((64, 64), (64, 65), (64, 256), (32, 32))
    ]
    assert waves == [2, 3, 6, 3]
    assert parse_amd(said.replace("10752", "0"), 64, {})[0].waves == 8


def test_a_function_that_the_program_lacks():
    """Registers are then a formula."""
    with pytest.raises(InputError, match="pose_step calls a function .* static, or"):
        parse_amd("remark: Function Name: pose_step [-R]\nremark:     TotalSGPRs: max(1, f) [-R]", 64, {})


def test_what_ptxas_says():
    usages = parse_nvidia(NVIDIA, "sm_70", {"blend_adjoint": 32, "rows": 128})
    assert usages == [Usage("blend_adjoint", 140, 0, 12, 0, 16, 7716, 12), Usage("rows", 20, waves=64)]


@pytest.mark.parametrize(
    "target, registers, local, group, waves",
    [
        ("sm_70", 32, 0, 256, 64),
        ("sm_70", 64, 0, 256, 32),
        ("sm_70", 20, 0, 32, 32),
        ("sm_70", 32, 33 << 10, 256, 16),
        ("sm_80", 32, 41 << 10, 256, 24),
        ("sm_90", 33, 0, 32, 32),
    ],
)
def test_waves_of_nvidia(target, registers, local, group, waves):
    """Bound by warps, registers, groups or local memory."""
    assert nvidia_waves(target, registers, local, group) == waves


def test_what_ocloc_says():
    assert parse_intel(INTEL) == [
        Usage("blend", 128, local=12832, waves=32),
        Usage("sweep", 256, 0, 128, 0, 128 + 204, 0, 16),
    ]


def test_sizes_are_those_of_the_target_s_wave():
    assert [sizes_of(TARGETS[name])["WAVE"] for name in ("gfx90a", "gfx1100", "sm_80")] == [64, 32, 32]


def test_a_missing_compiler_is_named_with_its_package(monkeypatch):
    monkeypatch.setattr("tools.offline.compilers.found", lambda need: None)
    assert "ocloc: install intel-ocloc of Debian testing, as .ci/nightly does" in missing([TARGETS["tgllp"]])
    with pytest.raises(InputError, match="ptxas: install PyPI's nvidia-cuda-nvcc-cu12"):
        offline.main(["sm_70", "--check"])
    with pytest.raises(InputError, match="sm_7: not a target; use gfx90a, "):
        offline.main(["sm_7"])


FOUND = {
    ("blend", "gfx90a"): Usage("blend", 48, waves=5, local=64),
    ("blend", "sm_80"): Usage("blend", 56, vector_spills=4, waves=36),
    ("scan", "gfx90a"): Usage("scan", 9, waves=8),
}


def stored():
    """The limits by FOUND, after they were written and read."""
    return offline.stored_limits(
        json.loads(json.dumps(line))
        for table in offline.tables(FOUND)
        for line in ({"table": table.title}, *(dict(zip(table.head, row)) for row in table.rows))
    )


def test_the_table_has_what_was_found():
    registers, memory = offline.tables(FOUND)
    assert registers.head == ("kernel", "gfx90a", "sm_80")
    assert registers.rows == [("blend", "48 / 5", "56 / 36 (4)"), ("scan", "9 / 8", "")]
    assert memory.rows == [("blend", "0 / 0 / 64", "")]
    assert stored() == {key: (usage.waves, usage.vector_spills) for key, usage in FOUND.items()}


def test_the_worst_of_several_builds():
    assert offline.worst([Usage("k", 9, local=8, waves=8), Usage("k", 7, scratch=4, waves=5)]) == (
        Usage("k", 9, scratch=4, local=8, waves=5)
    )


def test_a_spill_lost_waves_and_a_new_kernel_are_complaints():
    before = {**stored(), ("blend", "gfx90a"): (6, 0), ("blend", "sm_80"): (36, 0)}
    del before["scan", "gfx90a"]
    assert list(offline.complaints(FOUND, before)) == [
        "gfx90a blend: waves: 6 before, 5 now",
        "sm_80 blend: vector spills: 0 before, 4 now",
        "gfx90a scan: has no line in the evidence; run with --keep",
    ]


def test_what_the_table_allows_is_no_complaint():
    better = {("blend", "sm_80"): Usage("blend", 60, vector_spills=3, waves=40)}
    assert list(offline.complaints({**FOUND, **better}, stored())) == []
