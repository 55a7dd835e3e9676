"""Options at nonsense values: each is refused in one line, or is trained with, recorded and read
back as it was."""

import dataclasses
import json
import math
from typing import get_args

import numpy as np
import pytest

from clsplat.config import option as module
from clsplat.config.option import MOST_STEPS
from clsplat.densify.grow import Candidates
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.io.runs import run as run_module
from clsplat.io.runs.run import RunFolder
from clsplat.options import TrainOptions, checked, from_toml, resolve
from clsplat.schedule import laid_over

FIELDS = {field.name: field for field in dataclasses.fields(TrainOptions)}
NUMBERS = (0, 1, -1, 2, 1000, 1025, MOST_STEPS, MOST_STEPS + 1, 2**31, 2**32, 2**63 - 1, 2**63,
           10**300, 10**5000)
FLOATS = (0.0, -0.0, 5e-324, 1e-300, 1e-4, 0.1, 1.0, 1e3, 1e4, 1e15, 1.1e15, 1e38, 1e99, 1e100,
          1e101, 1e300, 1.7976931348623157e308, math.inf, -math.inf, math.nan, -1e-9)
TEXTS = ("", " ", "a", "\x00", "a\nb", "\udcff", "日本", "x" * 4096, "x" * 4097, "$\\frac{$")
TRIED = (*NUMBERS, *FLOATS, *TEXTS, True, False, None, [], {}, [1], [1.0] * 3, [[1]],
         [1e300] * 3, [0.5, math.nan, 0.5], [2.0, 1.0], [1] * 1001, b"a", 1j)


def accepted(name):
    """The values of TRIED that an option takes; the others are refused in one line."""
    taken = []
    for value in (*TRIED, *(FIELDS[name].metadata["choices"] or ())):
        try:
            taken.append(checked("here", name, value))
        except InputError as error:
            said = str(error)
            assert said.startswith(f"here: option '{name.replace('_', '-')}' expects "), said
            assert "\n" not in said and len(said) < 500
    return taken


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr(run_module, "origin", dict)
    return RunFolder.create(tmp_path / "run")


def test_whatever_an_option_takes_is_read_back_as_it_was(run):
    values = {name: accepted(name) for name in FIELDS}
    assert min(map(len, values.values())) >= 1
    for number in range(max(map(len, values.values()))):
        chosen = TrainOptions(**{name: some[number % len(some)] for name, some in values.items()})
        run.write_options({"scene": run.path, **dataclasses.asdict(chosen)})
        record = run.read_options()
        assert TrainOptions(**{name: checked("read", name, record[name]) for name in FIELDS}
                            ) == chosen


@pytest.mark.parametrize("name", [name for name, field in FIELDS.items()
                                  if float in (field.type, *get_args(field.type))
                                  or int in (field.type, *get_args(field.type))])
def test_a_limit_is_taken_and_what_is_beyond_refused(name, run):
    """Each numeric option by itself, as a training would record it."""
    field = FIELDS[name]
    kind = (get_args(field.type) or (field.type,))[0]
    high = field.metadata["maximum"] or field.metadata["most"] or module.MOST[kind]
    low = field.metadata["minimum"]
    beyond = (high + 1 if kind is int else math.nextafter(high, math.inf),
              low - 1 if kind is int else math.nextafter(low, -math.inf))

    def shaped(value):
        if name == "levels":
            return [value, 1.0] if value > 1 else [value]
        length = {"background": 3}.get(name)
        return [value] * (length or 1) if get_args(field.type) else value

    for value in (kind(low), kind(high)):
        taken = checked("here", name, shaped(value))
        run.write_options({"scene": run.path, **dataclasses.asdict(TrainOptions(**{name: taken}))})
        assert checked("read", name, run.read_options()[name]) == taken
    for value in beyond:
        if value in field.metadata["words"].values():
            continue  # what a word stands for
        with pytest.raises(InputError, match=f"here: option '{name.replace('_', '-')}' expects "):
            checked("here", name, shaped(value))


@pytest.mark.parametrize("given", [{"near": 1e15}, {"grow_threshold": 5e-324}, {"split_size": 1e15},
                                   {"schedule": "taming", "taming_budget": 1e15},
                                   {"seed": 2**63 - 1}])
def test_a_run_of_large_numbers_is_read_by_eval(run, given):
    options = resolve({}, given)
    run.write_options({"scene": run.path, **dataclasses.asdict(options)})
    assert Run(run).options == options


@pytest.mark.parametrize("given, said", [
    ({"near": 1e300}, "option 'near' expects at most 1e+15, got 1e+300"),
    ({"grow_threshold": 1e101}, "expects at most 1e+15"),
    ({"batch": 99_999_999_999}, "option 'batch' expects at most 1,024, got 99999999999"),
    ({"iterations": 10**9}, "option 'iterations' expects at most 10,000,000"),
    ({"steps_scale": 1e308}, "option 'steps-scale' expects at most 10000, got 1e+308"),
    ({"iterations": 10**6, "steps_scale": 100.0}, "--steps-scale 100: turns 1,000,000 steps into "
                                                  "more than 10,000,000; give a smaller factor"),
    ({"time_budget": "1e300"}, "option 'time-budget' expects at most a year"),
    ({"init": "a\x00b"}, "option 'init' expects text in Unicode"),
    ({"init": "\udcff.ply"}, "option 'init' expects text in Unicode"),
    ({"device": "x" * 5000}, "option 'device' expects at most 4096 characters"),
    ({"eval_at": [1] * 1001}, "option 'eval-at' expects at most 1000 values"),
    ({"levels": [1e16, 1.0]}, "option 'levels' expects at most 1e+15")])
def test_what_no_training_can_be_made_with_is_refused(given, said):
    with pytest.raises(InputError) as caught:
        resolve({}, given)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_time_budget_ends_in_a_number_of_steps_that_there_is():
    assert laid_over(resolve({}, {"iterations": 7000}), 10**300).iterations == MOST_STEPS


def test_a_config_as_large_as_a_disk_is_refused_at_once(tmp_path):
    path = tmp_path / "huge.toml"
    with open(path, "wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(InputError, match="huge.toml: is larger than 1 MiB"):
        from_toml(path)


def test_an_option_that_is_set_twice_is_refused(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text("sh-degree = 1\nsh_degree = 2\n")
    with pytest.raises(InputError, match="option 'sh_degree' is set twice"):
        from_toml(path)


@pytest.mark.parametrize("text", [
    "near = 1e300", "near = 1e400", "near = -1", "near = nan", "iterations = 1e3", "batch = 0",
    "init = 3", 'init = "\\u0000"', "levels = [1, 2]\nlevels = [2]", "[iterations]\na = 1",
    "iterations = 1979-05-27", '"" = 1', '"a b" = 1', "é = 1", "seed = -1", "\x00", "= 1",
    "eval_at = [0]", "background = [0, 0]", "background = [[0], 0, 0]", "snapshots = 1",
    "schedule = ''", "schedule = ['sig']", "near = inf", "seed = " + "9" * 5000])
def test_a_config_of_nonsense_is_one_line(tmp_path, text):
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        resolve(from_toml(path), {})
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.filterwarnings("error")
def test_opacities_of_any_logit_are_pruned_without_a_warning():
    """What `--opacity-rate 1e4` leads to."""
    logits = np.array([-1e4, 1e4, 0.0], np.float32)
    rows = {"log_scales": np.zeros((3, 3), np.float32), "opacity_logits": logits,
            "positions": np.zeros((3, 3), np.float32)}
    assert Candidates(rows, 1.0, TrainOptions(), False).prunes.tolist() == [True, False, False]


def test_a_record_holds_what_json_gives_back():
    options = resolve({}, {"near": 1e-300, "seed": 2**63 - 1})
    assert resolve(json.loads(json.dumps(dataclasses.asdict(options))), {}) == options
