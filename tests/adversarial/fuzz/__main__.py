"""Feeds one reader mutated files: `python -m tests.adversarial.fuzz READER SEED FIRST LAST`.

A reader, a seed and the number of a case make the same file again. A line of JSON names the case
that is read next, so that an abort or a hang is blamed on it, and another one has its outcome.
`--keep` as a fifth word leaves the folder of the case FIRST behind, and shows the traceback.
"""

import json
import os
import random
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

from clsplat.errors import InputError
from tests.adversarial.fuzz.mutate import mutated
from tests.adversarial.fuzz.readers import READERS

SECONDS = 60  # a case that takes longer hangs, also where other processes take most of the time
MEMORY_BYTES = 512 << 20  # a reader may take so much more than its process had
LONGEST = 1000  # characters of a message


def mutation(reader, seeds, seed, case):
    """(index of a folder of valid files, relative path of the mutated one, its bytes)."""
    chance = random.Random(f"{seed} {case}")
    at = chance.randrange(len(seeds))
    name = chance.choice([name for name in seeds[at] if name.endswith(reader.files)])
    other = chance.choice(seeds)
    return at, name, mutated(chance, seeds[at][name], other.get(name, seeds[at][name]), reader.text)


def written(files, folder):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def try_case(reader, folder):
    """ "" if the folder was read, None if it was refused as it should be, else the fault."""
    try:
        reader.read(folder)
        return ""
    except InputError as error:
        message, cause = str(error), error
        while cause is not None and not isinstance(cause, MemoryError):
            cause = cause.__context__
        if cause is not None or "bad_alloc" in message or "MemoryError" in message:
            return f"more memory than allowed: {message}"
        if not message.isprintable() or len(message) > LONGEST:
            return f"no clear line: {message[:300]!r}"
        return None
    except Exception as error:
        where = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)]
        return f"{type(error).__name__}: {str(error)[:200]!r} at {' '.join(where[-4:])}"


def limit_memory():
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def main(name, seed, first, last, *keep):
    reader = READERS[name]
    seeds = reader.seeds()
    if keep:
        at, file, content = mutation(reader, seeds, seed, int(first))
        folder = written({**seeds[at], file: content}, Path(tempfile.mkdtemp(prefix="clsplat-")))
        print(f"{folder}: {file} is mutated")
        reader.read(folder)
        return
    with tempfile.TemporaryDirectory(prefix="clsplat-fuzz-") as scratch:
        folders = [written(files, Path(scratch, str(at))) for at, files in enumerate(seeds)]
        warnings.simplefilter("error", RuntimeWarning)  # numpy's own
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng tells stderr all that it meets
        for folder in folders:
            assert try_case(reader, folder) == "", "a valid file is not read"
        limit_memory()
        for case in range(int(first), int(last)):
            print(json.dumps([case, "begun"]), flush=True)
            at, file, content = mutation(reader, seeds, seed, case)
            (folders[at] / file).write_bytes(content)
            signal.alarm(SECONDS)  # nobody handles it: a hang in C ends, too
            fault = try_case(reader, folders[at])
            signal.alarm(0)
            (folders[at] / file).write_bytes(seeds[at][file])
            print(json.dumps([case, {"": "read", None: "refused"}.get(fault, fault)]), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
