"""The table of options: TOML in, flags over it, one line for whatever is wrong."""

import dataclasses
import json

import click
import pytest
from click.testing import CliRunner

from clsplat.cli.flags import flag_name, given_options, training_flags
from clsplat.cli.sections import SectionedCommand
from clsplat.errors import InputError
from clsplat.options import TrainOptions, from_toml, resolve

FIELDS = {field.name: field for field in dataclasses.fields(TrainOptions)}


@pytest.fixture
def toml(tmp_path):
    def write(text):
        path = tmp_path / "run.toml"
        path.write_text(text)
        return path
    return write


def parse(*arguments):
    """What `given_options` finds in a command line."""
    found = {}

    @click.command(cls=SectionedCommand)
    @training_flags
    @click.pass_context
    def command(ctx, **_):
        found.update(given_options(ctx))

    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return found, result.output


def another(field):
    """A legal value that is not the default, and the arguments that give it."""
    flag, default, meta = flag_name(field.name), field.default, field.metadata
    if isinstance(default, bool):
        return not default, [flag if not default else "--no-" + flag[2:]]
    if meta["choices"]:
        return meta["choices"][-1], [flag, meta["choices"][-1]]
    if default == ():
        return (7, 9), [flag, "7", flag, "9"]
    if isinstance(default, tuple):
        return (0.5, 0.25, 1.0), [flag, "0.5", "0.25", "1.0"]
    if isinstance(default, str):
        return "text", [flag, "text"]
    value = type(default)(meta["maximum"] if meta["maximum"] is not None else 5)
    return value, [flag, str(value)]


@pytest.mark.parametrize("name", FIELDS)
def test_every_option_is_a_flag_and_a_key_that_agree(name, toml):
    value, arguments = another(FIELDS[name])
    assert parse(*arguments)[0] == {name: value}
    written = {True: "true", False: "false"}.get(value) if isinstance(value, bool) else (
        f'"{value}"' if isinstance(value, str) else str(list(value))
        if isinstance(value, tuple) else str(value))
    for key in (name, name.replace("_", "-")):
        assert from_toml(toml(f"{key} = {written}")) == {name: value}
    assert getattr(resolve({}, {name: value}), name) == value


def test_no_flag_is_given_by_default():
    assert parse()[0] == {}
    assert resolve({}, {}) == TrainOptions()


def test_the_default_given_aloud_counts_as_given():
    assert parse("-n", "30000", "--no-antialiased")[0] == {
        "iterations": 30000, "antialiased": False}


def test_short_names():
    assert parse("-n", "5", "-r", "2.5")[0] == {"iterations": 5, "downscale": 2.5}


def test_flags_win_over_the_file_and_the_file_over_defaults():
    options = resolve({"seed": 3, "iterations": 10}, {"seed": 4})
    assert (options.seed, options.iterations, options.sh_degree) == (4, 10, 3)


def test_help_has_each_group_once_with_defaults():
    text = parse("--help")[1]
    for heading in dict.fromkeys(field.metadata["group"] for field in FIELDS.values()):
        assert text.count(f"\n{heading}:\n") == 1
    assert "[default: 30000]" in " ".join(text.split())
    for name in FIELDS:
        assert flag_name(name) in text


@pytest.mark.parametrize("text, message", [
    ("iteration = 5", "unknown option 'iteration'"),
    ("iterations = 2.5", "'iterations' wants int, got 2.5"),
    ("iterations = true", "'iterations' wants int, got True"),
    ("iterations = 0", "'iterations' wants at least 1, got 0"),
    ("sh_degree = 4", "'sh_degree' wants from 0 to 3, got 4"),
    ("ssim-weight = nan", "'ssim_weight' wants from 0.0 to 1.0"),
    ("optimizer = 'sgd'", "'optimizer' wants one of dense, sparse"),
    ("background = [1, 1]", "'background' wants three numbers"),
    ("iterations = ", "not valid TOML"),
])
def test_a_wrong_file_is_one_line_that_names_it(text, message, toml):
    path = toml(text)
    with pytest.raises(InputError) as caught:
        resolve(from_toml(path), {})
    assert str(caught.value).startswith(f"{path}: ") and message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_text_or_not_there(tmp_path):
    (tmp_path / "run.toml").write_bytes(b"\xff\xfe\x00")
    for path, message in ((tmp_path / "run.toml", "not valid TOML"),
                          (tmp_path / "none.toml", "cannot be read"), (tmp_path, "cannot be read")):
        with pytest.raises(InputError, match=message):
            from_toml(path)


def test_a_flag_out_of_its_limits_is_refused():
    with pytest.raises(InputError, match="command line: option 'downscale' wants at least 1.0"):
        resolve({}, {"downscale": 0.5})


def test_whole_numbers_serve_as_fractions():
    assert resolve({"downscale": 2}, {}).downscale == 2.0


@pytest.mark.parametrize("text, wish", [
    ("eval_at = ['a']", "a list of steps"),
    ("eval_at = [0]", "a list of steps"),
    ("eval_at = [2.5]", "a list of steps"),
    ("eval_at = [true]", "a list of steps"),
    ("eval_at = [[7]]", "a list of steps"),
    ("eval_at = 7", "a list of steps"),
    ("background = ['a', 'b', 'c']", "three numbers from 0 to 1"),
    ("background = [0, 0, 1.5]", "three numbers from 0 to 1"),
    ("background = [0, nan, 0]", "three numbers from 0 to 1"),
    ("background = 0.5", "three numbers from 0 to 1"),
    ("background = 'red'", "three numbers from 0 to 1"),
    ("downscale = inf", "a finite number"),
    ("downscale = nan", "at least 1.0"),
    ("grow_threshold = inf", "a finite number"),
])
def test_elements_and_infinities_are_refused(text, wish, toml):
    path = toml(text)
    with pytest.raises(InputError) as caught:
        from_toml(path)
    key = text.split(" ")[0]
    assert str(caught.value).startswith(f"{path}: option '{key}' wants {wish}")
    assert ", got " in str(caught.value) and "\n" not in str(caught.value)


def test_an_infinite_flag_is_refused():
    with pytest.raises(InputError, match="command line: option 'downscale' wants a finite number"):
        resolve({}, {"downscale": float("inf")})


def test_lists_of_a_run_s_record_become_tuples():
    values = json.loads(json.dumps(dataclasses.asdict(
        TrainOptions(eval_at=(3, 5), background=(1, 0.5, 0)))))
    assert resolve(values, {}) == TrainOptions(eval_at=(3, 5), background=(1.0, 0.5, 0.0))
    assert all(type(v) is float for v in resolve(values, {}).background)
