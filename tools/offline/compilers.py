"""Compiles a program for a target with the compiler of its vendor, and reads what that says."""

from __future__ import annotations

import importlib.util
import math
import os
import re
import shutil
import subprocess
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from clsplat.constants import SHARED
from clsplat.device.programs import define_options, kernel_source
from clsplat.device.tuning import tuning_of
from clsplat.errors import InputError
from tools.offline.work import Program

CLANG, OLDER_CLANG, TRANSLATOR = "clang-22", "clang-15", "llvm-spirv-15"
# where Debian's packages are unpacked by `dpkg -x`, if they are not installed: libclc-22 cannot be
# installed beside Mesa's OpenCL
UNPACKED = Path(os.environ.get("CLSPLAT_COMPILERS", "/")).resolve()


def _placed(name: str) -> Path:
    """A file of a package, unpacked or installed."""
    return next((place for place in (UNPACKED / name, Path("/") / name) if place.exists()), Path("/") / name)


AMD_LIBRARY = _placed("usr/lib/clc/amdgcn-amd-amdhsa.bc")
NVIDIA_LIBRARY = _placed("usr/lib/clc/nvptx64--nvidiacl.bc")
DEVICE_LIBRARIES = _placed("usr/lib/x86_64-linux-gnu/amdgcn/bitcode")
CUDA = {"ptxas": "bin/ptxas", "libdevice": "nvvm/libdevice/libdevice.10.bc"}  # in its package
PACKAGES: dict[str | Path, str] = {  # what a target needs -> the package that has it
    CLANG: "Debian's clang-22",
    OLDER_CLANG: "Debian's clang-15",
    TRANSLATOR: "Debian's llvm-spirv-15",
    "spirv-val": "Debian's spirv-tools",
    "ocloc": "intel-ocloc of Debian testing, as .ci/nightly does",
    **dict.fromkeys(CUDA, "PyPI's nvidia-cuda-nvcc-cu12"),
    AMD_LIBRARY: "Debian's libclc-22",
    NVIDIA_LIBRARY: "Debian's libclc-22",
    DEVICE_LIBRARIES: "Debian's rocm-device-libs",
}
# KiB of local memory of a multiprocessor, and what each group takes of it besides its own
NVIDIA_LOCAL = {"sm_70": (96, 0), "sm_80": (164, 1), "sm_90": (228, 1)}
AMD_LOCAL, AMD_SIMDS = {64: 64 << 10, 32: 128 << 10}, 4  # bytes that so many SIMDs share, by lanes
NVIDIA_WARPS, NVIDIA_GROUPS, NVIDIA_REGISTERS = 64, 32, 1 << 16  # of a multiprocessor


@dataclass(frozen=True)
class Usage:
    """What a compiled kernel takes of its target."""

    kernel: str
    vector: int = 0  # registers
    scalar: int = 0  # registers, each shared by the lanes of a wave
    # registers that were spilled to memory, or bytes of a lane where the compiler counts these; 0
    # where it does not say
    vector_spills: int = 0
    scalar_spills: int = 0
    scratch: int = 0  # bytes of a lane's private memory
    local: int = 0  # bytes of a group's local memory
    # that run at a time on a SIMD (AMD) or a multiprocessor (NVIDIA); for Intel, lanes of a thread,
    # which its compiler makes fewer where registers do not suffice
    waves: int = 0


@dataclass(frozen=True)
class Target:
    """A device to compile for."""

    name: str  # for the compiler
    form: str  # of the kernels that it runs
    wave: int  # lanes that run in step
    needs: tuple[str | Path, ...]  # programs and files that must be installed
    # (target, source file, options, kernel -> size of its groups) -> usages
    compile: Callable[[Target, Path, Sequence[str], Mapping[str, int]], list[Usage]]


def compiled(target: Target, program: Program, folder: Path) -> list[Usage]:
    """The usages of a program's kernels, by files in an empty folder; InputError: it fails."""
    source = folder / "program.cl"
    source.write_text(kernel_source(program.file), encoding="utf-8")
    sizes = sizes_of(target)
    options = [
        "-cl-std=CL1.2",
        "-cl-single-precision-constant",
        "-DREAL_IS_DOUBLE=0",
        f"-DFORM_ITEM={int(target.form == 'item')}",
        "-DHAVE_NATIVE_EXP=1",
        "-DHAVE_NATIVE_DIVIDE=1",
        *define_options((*sizes.items(), *program.choices)),
    ]  # as `clsplat.device.Device`
    numbers = {**SHARED, **sizes, "": tuning_of("gpu", target.wave)["group_size"]}
    groups = {
        kernel: math.prod(int(numbers.get(word, word)) for word in text.split() or [""])
        for kernel, text in program.kernels.items()
    }
    return [usage for usage in target.compile(target, source, options, groups) if usage.kernel in groups]


def sizes_of(target: Target) -> dict[str, int]:
    """`DEVICE_SIZES` of the target."""
    row = tuning_of("gpu", target.wave)
    return {
        "TILE": row["tile"],
        "SCAN_GROUP": row["scan_group"],
        "WAVE": target.wave,
        "BUCKET": row["bucket"],
        "ADJOINT_GROUP": row["adjoint_waves"] * target.wave,
    }


def missing(targets: Iterable[Target]) -> list[str]:
    """What the targets need and is not installed, with the package that has it."""
    needed = {need for target in targets for need in target.needs}
    return sorted(f"{need}: install {PACKAGES[need]}" for need in needed if not found(need))


def found(need: str | Path) -> str | None:
    """The path of a program or file, if it is there."""
    if isinstance(need, Path):
        return str(need) if need.exists() else None
    if need in CUDA:  # not the system's ptxas, which may be too new for sm_70
        has = importlib.util.find_spec("nvidia") and importlib.util.find_spec("nvidia.cuda_nvcc")
        for folder in has and has.submodule_search_locations or ():
            if (file := Path(folder) / CUDA[need]).exists():
                return str(file)
        return None
    folders = str(UNPACKED / "usr/bin"), os.environ.get("PATH", "")
    return shutil.which(need, path=os.pathsep.join(folders))


def output_of(*words: str | Path) -> str:
    """What a command prints; InputError with its last lines where it fails."""
    program = found(words[0])
    assert program, words[0]
    libraries = str(UNPACKED / "usr/lib/x86_64-linux-gnu")
    ended = subprocess.run(
        [program, *map(str, words[1:])],
        capture_output=True,
        text=True,
        errors="replace",
        env={**os.environ, "LD_LIBRARY_PATH": libraries},
    )
    text = ended.stdout + ended.stderr
    if ended.returncode:
        raise InputError(f"{' '.join(map(str, words[:1]))} fails: {text[-1500:]}")
    return text


def clang(
    target: str,
    source: Path,
    options: Sequence[str],
    libraries: Sequence[Path],
    *more: str | Path,
    program: str = CLANG,
) -> str:
    """What clang says of a program."""
    links = [word for library in libraries for word in ("-Xclang", "-mlink-builtin-bitcode", "-Xclang", library)]
    return output_of(
        program,
        "-x",
        "cl",
        f"--target={target}",
        "-O3",
        "-Wno-everything",
        "-Xclang",
        "-finclude-default-header",
        *options,
        *links,
        *more,
        source,
    )


def amd(target: Target, source: Path, options: Sequence[str], groups: Mapping[str, int]) -> list[Usage]:
    """For AMD: libclc, or AMD's own library for the one target of it that both have."""
    libraries = [AMD_LIBRARY]
    if target.name == "gfx1030":
        names = (
            "opencl",
            "ocml",
            "ockl",
            "oclc_finite_only_off",
            "oclc_unsafe_math_off",
            "oclc_daz_opt_off",
            "oclc_correctly_rounded_sqrt_off",
            "oclc_wavefrontsize64_off",
            "oclc_isa_version_1030",
            "oclc_abi_version_500",
        )
        libraries = [DEVICE_LIBRARIES / f"{name}.bc" for name in names]
    return parse_amd(
        clang(
            "amdgcn-amd-amdhsa",
            source,
            options,
            libraries,
            "-nogpulib",
            f"-mcpu={target.name}",
            "-Rpass-analysis=kernel-resource-usage",
            "-c",
            "-o",
            source.with_suffix(".o"),
        ),
        target.wave,
        groups,
    )


def parse_amd(text: str, wave: int, groups: Mapping[str, int]) -> list[Usage]:
    """The remarks of clang's kernel-resource-usage, with the waves of groups of their true size:
    where a kernel does not say it, clang takes a larger one."""
    usages = []
    for part in text.split("Function Name: ")[1:]:
        number = {name: int(value) for name, value in re.findall(r"remark: (?:\S+ )?\s*([A-Za-z][^:\n]*): (\d+)", part)}
        if "VGPRs" not in number:  # a formula, as the compiler does not know what is called
            raise InputError(
                f"{part.split()[0]} calls a function that the program lacks: make "
                "one that is not inlined static, or with barriers always_inline"
            )
        kernel, local = part.split()[0], number["LDS Size [bytes/block]"]
        waves, of_a_group = number["Occupancy [waves/SIMD]"], -(-groups.get(kernel, wave) // wave)
        if local:
            waves = min(waves, -(-(AMD_LOCAL[wave] // local * of_a_group) // AMD_SIMDS))
        usages.append(
            Usage(
                kernel,
                number["VGPRs"] + number.get("AGPRs", 0),
                number["TotalSGPRs"],
                number["VGPRs Spill"],
                number["SGPRs Spill"],
                number["ScratchSize [bytes/lane]"],
                local,
                waves,
            )
        )
    return usages


def nvidia(target: Target, source: Path, options: Sequence[str], groups: Mapping[str, int]) -> list[Usage]:
    """For NVIDIA: PTX by clang, though the driver has a front end of its own, then ptxas."""
    ptx = source.with_suffix(".ptx")
    clang(
        "nvptx64--nvidiacl",
        source,
        options,
        [NVIDIA_LIBRARY, Path(found("libdevice") or "")],
        "-Xclang",
        "-target-cpu",
        "-Xclang",
        target.name,
        "-S",
        "-o",
        ptx,
    )
    said = output_of("ptxas", "-v", "-arch", target.name, ptx, "-o", source.with_suffix(".o"))
    return parse_nvidia(said, target.name, groups)


def parse_nvidia(said: str, target: str, groups: Mapping[str, int]) -> list[Usage]:
    """What `ptxas -v` says, and the waves that follow from it."""
    usages = []
    for part in said.split("Compiling entry function '")[1:]:
        kernel = part.partition("'")[0]

        def number(pattern: str, part: str = part) -> int:
            match = re.search(pattern, part)
            return int(match[1]) if match else 0

        registers, local = number(r"Used (\d+) registers"), number(r"(\d+) bytes smem")
        usages.append(
            Usage(
                kernel,
                registers,
                vector_spills=number(r"(\d+) bytes spill stores"),
                scratch=number(r"(\d+) bytes stack frame"),
                local=local,
                waves=nvidia_waves(target, registers, local, groups.get(kernel, 32)),
            )
        )
    return usages


def nvidia_waves(target: str, registers: int, local: int, group: int) -> int:
    """How many warps of a kernel a multiprocessor holds, in complete groups."""
    warps, (memory, own) = -(-group // 32), (size << 10 for size in NVIDIA_LOCAL[target])
    of_a_warp = -(-registers * 32 // 256) * 256  # allocated in units of 256
    groups = min(
        NVIDIA_GROUPS,
        NVIDIA_WARPS // warps,
        NVIDIA_REGISTERS // of_a_warp // warps,
        memory // (local + own) if local + own else NVIDIA_GROUPS,
    )
    return groups * warps


def intel(target: Target, source: Path, options: Sequence[str], groups: Mapping[str, int]) -> list[Usage]:
    """For Intel: ocloc, whose binary says what its kernels take."""
    folder = source.parent
    output_of(
        "ocloc",
        "compile",
        "-file",
        source,
        "-device",
        target.name,
        "-out_dir",
        folder,
        "-output",
        "intel",
        "-options",
        " ".join(options),
    )
    binary = next(folder.glob("intel_*.bin"))
    output_of("ocloc", "disasm", "-file", binary, "-dump", folder / "dump", "-device", target.name)
    return parse_intel((folder / "dump" / ".ze_info").read_text(encoding="utf-8"))


def parse_intel(text: str) -> list[Usage]:
    """The section .ze_info of a binary, whose sizes are bytes of a thread."""
    usages = []
    for part in text.partition("kernels_misc_info:")[0].split("\n  - name:")[1:]:
        number = defaultdict(int, {name: int(value) for name, value in re.findall(r"(?m)^      (\w+): +(\d+)$", part)})
        lanes = number["simd_size"]
        spilled, private = number["spill_size"] // lanes, number["private_size"] // lanes
        usages.append(
            Usage(
                part.split()[0],
                vector=number["grf_count"],
                waves=lanes,
                vector_spills=spilled,
                scratch=spilled + private,
                local=number["slm_size"],
            )
        )
    return usages


def spirv(target: Target, source: Path, options: Sequence[str], groups: Mapping[str, int]) -> list[Usage]:
    """SPIR-V for any runtime, which spirv-val must find valid."""
    bitcode, module = source.with_suffix(".bc"), source.with_suffix(".spv")
    clang(
        "spir64", source, options, (), "-emit-llvm", "-c", "-o", bitcode, "-O0", program=OLDER_CLANG
    )  # the translator has no word for what optimised code may contain
    output_of(TRANSLATOR, "--spirv-max-version=1.2", bitcode, "-o", module)
    output_of("spirv-val", "--target-env", "opencl1.2", module)
    return []


TARGETS = {
    target.name: target
    for target in (
        *(
            Target(name, "group", 64 if name.startswith("gfx9") else 32, (CLANG, AMD_LIBRARY), amd)
            for name in ("gfx90a", "gfx942")
        ),
        Target("gfx1030", "group", 32, (CLANG, DEVICE_LIBRARIES), amd),
        *(Target(name, "group", 32, (CLANG, AMD_LIBRARY), amd) for name in ("gfx1100", "gfx1201")),
        *(Target(name, "group", 32, ("ocloc",), intel) for name in ("tgllp", "acm-g10", "bmg")),
        # older packages of libclc have NVIDIA's library as well, but not AMD's of this name
        *(Target(name, "group", 32, (CLANG, AMD_LIBRARY, NVIDIA_LIBRARY, *CUDA), nvidia) for name in NVIDIA_LOCAL),
        *(
            Target(f"spirv-{form}", form, 32, (OLDER_CLANG, TRANSLATOR, "spirv-val"), spirv)
            for form in ("item", "group")
        ),
    )
}
