"""The table of options: TOML in, flags over it, one line for whatever is wrong."""

import ast
import dataclasses
import json

import click
import pytest
from click.testing import CliRunner

from clsplat.cli.flags import TrainingCommand, given_options, training_flags
from clsplat.cli.main import main
from clsplat.config.option import checked, expected, flag_name, shown_name
from clsplat.options import TrainOptions, from_toml, resolve, seconds_of, serves
from clsplat.schedule.registry import OURS, schedule_of
from clsplat.schedule.sig_options import PAPER, RELEASE
from tests.layout import ROOT
from tests.refusals import refused

FIELDS = {field.name: field for field in dataclasses.fields(TrainOptions)}
OF_SIG = {"average": 0.0, "opacity_weight": 0.0}  # what others leave out
FLAGS = [name for name, field in FIELDS.items() if field.metadata["flag"]]


@pytest.fixture
def toml(tmp_path):
    def write(text):
        path = tmp_path / "run.toml"
        path.write_text(text)
        return path

    return write


def invoke(*arguments):
    """(what `given_options` finds in a command line, click's result)."""
    found = {}

    @click.command(cls=TrainingCommand)
    @training_flags
    @click.pass_context
    def command(ctx, **_):
        found.update(given_options(ctx))

    return found, CliRunner().invoke(command, arguments, catch_exceptions=False)


def parse(*arguments):
    """What `given_options` finds in a command line, and what it prints."""
    found, result = invoke(*arguments)
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
        return (9, 7, 1), [flag, "9,7", flag, "1"]
    if field.name in ("time_budget", "memory_budget"):
        value = "90s" if field.name == "time_budget" else "96MiB"
        return value, [flag, value]
    if isinstance(default, tuple):
        return (0.5, 0.25, 1.0), [flag, "0.5", "0.25", "1.0"]
    if field.type is str:
        return "text", [flag, "text"]
    value = field.type(
        meta["maximum"]
        if meta["maximum"] not in (None, default)
        else meta["minimum"]
        if meta["maximum"] == default
        else 5
    )
    return value, [flag, str(value)]


def serving(name):
    """The schedules to which an option means something."""
    return [schedule for schedule in OURS if serves(FIELDS[name], schedule)]


# other packages register the values of add_parts: tests/config/test_plug_in.py
@pytest.mark.parametrize("name", [name for name in FIELDS if name != "add_parts"])
def test_an_option_s_flag_if_it_has_one_and_its_key_agree(name, toml):
    value, arguments = another(FIELDS[name])
    if name in FLAGS:
        assert parse(*arguments)[0] == {name: value}
    else:
        assert refused(lambda: invoke(*arguments)) == (
            f"{arguments[0]}: is a key of the file of --config and no flag; write {name} = VALUE there"
        )
    written = (
        {True: "true", False: "false"}.get(value)
        if isinstance(value, bool)
        else (f'"{value}"' if isinstance(value, str) else str(list(value)) if isinstance(value, tuple) else str(value))
    )
    for key in (name, name.replace("_", "-")):
        assert from_toml(toml(f"{key} = {written}")) == {name: value}
    around = {} if name == "schedule" else {"schedule": serving(name)[0]}
    assert getattr(resolve({}, {**around, name: value}), name) == value


def test_few_functions_take_all_options():
    """Others take the group that they read; see `ScheduledOptions`."""
    found = [
        function.name
        for path in (ROOT / "clsplat").rglob("*.py")
        if "TrainOptions" in (text := path.read_text("utf-8"))
        for function in ast.walk(ast.parse(text))
        if isinstance(function, ast.FunctionDef)
        and any(
            argument.annotation and "TrainOptions" in ast.unparse(argument.annotation)
            for argument in (*function.args.args, *function.args.kwonlyargs)
        )
    ]
    assert "prepare" in found and len(found) <= 15, found


def test_no_flag_is_given_by_default():
    assert parse()[0] == {}
    assert resolve({}, {}) == TrainOptions()


def test_flags_win_over_the_file_and_the_file_over_defaults():
    options = resolve({"seed": 3, "iterations": 10}, {"seed": 4})
    assert (options.seed, options.iterations, options.sh_degree) == (4, 10, 3)


def test_help_has_each_group_once_with_defaults():
    text = parse("--help-all")[1]
    for heading in dict.fromkeys(FIELDS[name].metadata["group"] for name in FLAGS):
        assert text.count(f"\n{heading}:\n") == 1
    assert "[default: 1600]" in " ".join(text.split())
    for name in FIELDS:
        assert (f"{flag_name(name)} " in text.replace("/", " ")) == (name in FLAGS), name
        assert (f"\n  {name} " in text) == (name not in FLAGS), "keys of --config"


def test_a_training_has_at_most_42_flags():
    shared = {"--help", "--help-all", "--traceback"}
    assert (
        sum(
            option.opts[-1] not in shared
            for option in main.commands["train"].params
            if isinstance(option, click.Option)
        )
        <= 42
    )


@pytest.mark.parametrize(
    "text, message",
    [
        ("iteration = 5", "unknown option 'iteration'"),
        ("iterations = 2.5", "'iterations' expects auto or a whole number of at least 1, got 2.5"),
        ("iterations = true", "'iterations' expects auto or a whole number of at least 1, got True"),
        ("iterations = 0", "'iterations' expects auto or a whole number of at least 1, got 0"),
        ("sh_degree = 4", "'sh-degree' expects a whole number from 0 to 3, got 4"),
        ("ssim-weight = nan", "'ssim-weight' expects a number from 0 to 1"),
        ("engine = 'gpu'", "'engine' expects one of auto, device, coded, numpy"),
        ("background = [1, 1]", "'background' expects three numbers"),
        ("iterations = ", "not valid TOML"),
        ("downscale = inf", "'downscale' expects a finite number"),
        ("background = 7", "option 'background' expects three numbers from 0 to 1, got "),
        ("background = ['a', 'b', 'c']", "'background' expects three numbers from 0 to 1"),
        ("background = [0, 0, 1.5]", "'background' expects three numbers from 0 to 1"),
        ("grow_threshold = inf", "'grow-threshold' expects a finite number"),
    ],
)
def test_a_wrong_file_is_one_line_that_names_it(text, message, toml):
    path = toml(text)
    assert refused(lambda: resolve(from_toml(path), {}), message).startswith(f"{path}: ")


def test_choices_set_what_there_is_to_legal_values():
    tables = [("schedule", name, schedule_of(name).defaults) for name in OURS] + [
        (name, value, table) for name, field in FIELDS.items() for value, table in field.metadata["sets"].items()
    ]
    assert len(tables) >= 9
    assert all({**OF_SIG, "exposure": "off"}.items() <= table.items() for table in (PAPER, RELEASE))
    for choice, value, chosen in tables:
        assert value in (FIELDS[choice].metadata["choices"] or (True, False))
        for name, other in chosen.items():
            assert checked(TrainOptions, "choice", name, other) == other
            assert other != FIELDS[name].default, (choice, value, name)


@pytest.mark.parametrize(
    "given, chosen",
    [
        (
            {"schedule": "constant"},
            {"reset_every": 3000, "exposure": "off", "opacity_rate": 0.05, "prune_size": 0.1, **OF_SIG},
        ),
        ({"schedule": "dash"}, {"reset_every": 3000, "exposure": "off", **OF_SIG}),
        ({"schedule": "taming"}, {"reset_every": 3000, "exposure": "off", "prune_size": 0.1, **OF_SIG}),
        (
            {"schedule": "mcmc"},
            {"exposure": "off", "opacity_rate": 0.05, "position_noise": 5e5, "scale_weight": 0.01, "average": 0.0},
        ),
        ({"schedule": "sig"}, {}),
        ({"preset": "paper"}, PAPER),
        ({"preset": "release"}, RELEASE),
        ({"size": "L"}, {"grow_threshold": 1.25e-4}),
        (
            {"schedule": "constant", "size": "L"},
            {
                "reset_every": 3000,
                "exposure": "off",
                "opacity_rate": 0.05,
                "prune_size": 0.1,
                "grow_threshold": 1.25e-4,
                **OF_SIG,
            },
        ),
    ],
)
def test_a_choice_sets_its_own_and_nothing_else(given, chosen):
    assert resolve({}, given) == TrainOptions(**given, **chosen)
    assert resolve(given, {}) == TrainOptions(**given, **chosen)


@pytest.mark.parametrize(
    "choice, own",
    [
        ({"schedule": "constant"}, {"reset_every": 0}),
        ({"schedule": "dash"}, {"exposure": "auto"}),
        ({"preset": "paper"}, {"densify_every": 0}),
        ({"size": "L"}, {"grow_threshold": 2e-4}),
    ],
)
def test_what_is_given_wins_even_if_it_is_the_default(choice, own):
    for options in (resolve({}, {**choice, **own}), resolve(own, choice), resolve(choice, own)):
        for name, value in own.items():
            assert getattr(options, name) == value, name


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"schedule": "constant"},
        {"schedule": "dash"},
        {"schedule": "taming"},
        {"schedule": "mcmc"},
        {"preset": "paper"},
        {"preset": "release", "levels": (4, 1)},
        {"size": "L"},
        {"time_budget": "10m"},
    ],
)
def test_a_run_s_record_gives_the_same_options_again(given):
    options = resolve({}, given)
    assert resolve(json.loads(json.dumps(dataclasses.asdict(options))), {}) == options


@pytest.mark.parametrize("name", [name for name, field in FIELDS.items() if field.metadata["part"]])
@pytest.mark.parametrize("schedule", OURS)
def test_an_option_of_another_schedule_is_refused(name, schedule):
    field, only = FIELDS[name], serving(name)
    value, _ = another(field)
    if schedule in only:
        resolve({}, {"schedule": schedule, name: value})
        return
    assert refused(lambda: resolve({}, {"schedule": schedule, name: value})) == (
        f"{shown_name(field)}: has no effect with --schedule {schedule}; leave it out, or use "
        f"--schedule {' or '.join(only)}"
    )
    assert getattr(resolve({}, {"schedule": schedule, name: field.default}), name) == field.default


@pytest.mark.parametrize(
    "levels, shown",
    [
        ((4, 2), "4,2"),
        ((1, 2, 4), "1,2,4"),
        ((4, 4, 1), "4,4,1"),
        ((2, 4, 1), "2,4,1"),
        ((2.5, 1, 1), "2.5,1,1"),
        ((3,), "3"),
    ],
)
def test_levels_that_do_not(levels, shown):
    said = "expects auto or factors that fall and end at 1, such as 4,2,1"
    assert refused(lambda: resolve({}, {"levels": levels})) == (f"option 'levels' {said}, got {levels}")
    assert refused(lambda: invoke("--levels", shown)) == f"--levels {shown}: {said}"


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (["--levels", "4,2,1"], {"levels": (4.0, 2.0, 1.0)}),
        (["--levels", "4", "--levels", "2.5,1"], {"levels": (4.0, 2.5, 1.0)}),
        (["--levels", "2, 1"], {"levels": (2.0, 1.0)}),
    ],
)
def test_lists_have_commas_or_come_in_parts(arguments, expected):
    found = parse(*arguments)[0]
    assert found == expected
    assert {name: [type(v) for v in values] for name, values in found.items()} == {
        name: [type(v) for v in values] for name, values in expected.items()
    }


@pytest.mark.parametrize(
    "text, seconds", [("90", 90), ("90s", 90), ("10m", 600), ("2h", 7200), ("1.5h", 5400), ("0.5", 0.5), ("1e3", 1000)]
)
def test_seconds_of_a_time_budget(text, seconds):
    assert seconds_of(text) == seconds
    assert resolve({}, {"time_budget": text}).time_budget == text


@pytest.mark.parametrize("text", ["0", "-5m", "m", "s", "10 minutes", "1h30m", "nan", "inf", "infh", "2d", " ", "10M"])
def test_what_is_no_time_is_refused(text):
    assert refused(lambda: resolve({}, {"time_budget": text})) == (
        f"option 'time-budget' expects none or a number of seconds, or one with s, m or h such as 10m, got {text!r}"
    )


def test_a_time_budget_and_a_number_of_steps_contradict():
    refused(
        lambda: resolve({"iterations": 500}, {"time_budget": "10m"}),
        "--time-budget: decides the number of steps, as -n does; leave one of them out",
    )
    assert resolve({}, {"time_budget": ""}).iterations == "auto"  # none: nothing to refuse
    assert resolve({}, {"time_budget": "10m", "preset": "paper"}).iterations == 30_000


WORDS = [(name, word) for name, field in FIELDS.items() for word in field.metadata["words"]]


@pytest.mark.parametrize("name, word", WORDS)
def test_a_word_is_a_flag_a_key_and_a_record_that_agree(name, word, toml):
    meaning = FIELDS[name].metadata["words"][word]
    if name in FLAGS:
        assert parse(flag_name(name), word)[0] == {name: meaning}
    assert from_toml(toml(f'{name} = "{word}"')) == {name: meaning}
    assert checked(TrainOptions, "options.json", name, word) == meaning
    written = json.loads(json.dumps(meaning))  # what is recorded, and what users had before
    assert checked(TrainOptions, "options.json", name, written) == meaning
    assert word in expected(FIELDS[name])


@pytest.mark.parametrize("field", FIELDS.values(), ids=list(FIELDS))
def test_an_option_says_what_it_affects(field):
    assert field.metadata["affects"] in ("model", "time", "nothing")
    assert field.metadata["help"][0].islower() or field.metadata["help"][0].isupper()
    assert not field.metadata["help"].endswith(".")


def test_presets_are_what_the_paper_and_the_release_say():
    paper, release = (resolve({}, {"preset": preset}) for preset in ("paper", "release"))
    assert paper.levels == (5, 4, 3, 2, 1) and release.levels == (5, 2.5, 5 / 3, 1.25, 1)
    assert (paper.sphere_neighbours, paper.sphere_shrink, paper.sphere_rule) == (15, 0.7, "paper")
    assert (release.sphere_neighbours, release.sphere_shrink, release.sphere_rule) == (8, 0.8, "release")
    assert paper.sphere_reach == release.sphere_reach == 15
    assert paper.level_share == release.level_share == 1  # no deadlines
