"""What an option affects: who takes two runs for the same, and whether the model's bytes agree."""

import dataclasses
from types import SimpleNamespace

import pytest

from clsplat.cities import block as block_module
from clsplat.cities import city as cities
from clsplat.cli.campaign import run_campaign
from clsplat.cli.train import resumed_options
from clsplat.config.option import differences, plain
from clsplat.errors import InputError, Interrupted
from clsplat.io.runs.run import RunFolder
from clsplat.options import resolve
from clsplat.partition.options import PartitionOptions
from clsplat.report import compare
from clsplat.report.groups import Trained, differing
from clsplat.training.run import train
from tests.data.tiny_training import LEVELLED, model_digest, options_of, resume, trained
from tests.test_options import FIELDS, another, serving

AFFECTS = {name: field.metadata["affects"] for name, field in FIELDS.items()}
TINY = {
    **LEVELLED,
    "iterations": 12,
    "levels": (2.0, 1.0),
    "level_share": 0.4,
    "densify_from": 2,
    "densify_every": 2,
    "reproject": "off",
}
CHANGES = {"checkpoint_every": 4, "device": "cpu", "eval_every": 4, "stop_at": 5}


def refuses(call, *arguments):
    try:
        call(*arguments)
    except InputError:
        return True
    return False


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.one_in(5)
def test_all_who_ask_whether_a_run_is_the_same_agree(name, tmp_path, monkeypatch):
    around = {} if name == "schedule" else {"schedule": serving(name)[0]}
    here = resolve({}, around)
    value = another(FIELDS[name])[0]
    if value == "text":
        value = "x"
    other = dataclasses.replace(here, **{name: value})
    record, differs = plain(here), AFFECTS[name] != "nothing"
    assert [found for found, _, _ in differences(record, other)] == [name] * differs
    # going on with a run, a campaign, a block and a city
    assert refuses(resumed_options, record, {name: value}) == differs
    run = RunFolder.create(tmp_path / "run")
    run.write_options({"scene": tmp_path, **dataclasses.asdict(here)})
    place = tmp_path / f"{other.schedule}.{other.seed}"
    place.symlink_to(run.path)
    monkeypatch.setattr(compare, "write_comparison", lambda *_: ("", place))
    assert refuses(run_campaign, lambda *_: None, [other], tmp_path) == differs
    block = SimpleNamespace(run=run.path, exchanges=[])
    with monkeypatch.context() as patch:
        patch.setattr(block_module, "block_options", lambda _: other)
        patch.setattr(RunFolder, "is_finished", True)
        assert refuses(block_module.train_block, block) == (differs and name != "init")  # it moves
    city = SimpleNamespace(
        has_record=True,
        path=tmp_path,
        coarse=run.path,
        make=lambda: None,
        write=lambda _: None,
        read=lambda options: {"fingerprint": "f", "options": record},
    )
    monkeypatch.setattr(cities, "scene_record", lambda *_: {})
    monkeypatch.setattr(cities, "fingerprint", lambda _: "f")
    whole = cities.City(city, SimpleNamespace(path=str(tmp_path)), other, None)
    assert refuses(whole.begin) == differs
    # a comparison: of models, over seeds; what `form` became is a fact of its own
    two = [Trained(str(number), plain(options), [], True) for number, options in enumerate((here, other))]
    compared = AFFECTS[name] == "model" and name not in ("seed", "form")
    assert (name in differing(two)) == compared


@pytest.mark.slow
def test_what_does_not_affect_the_model_leaves_its_bytes(item_device, city, tmp_path):
    """All of these options at once, and the rest of the run without them."""
    assert {*CHANGES} == {name for name, what in AFFECTS.items() if what != "model"}
    plain_run = trained(tmp_path / "plain", city, item_device, **TINY)
    options = options_of(**{**TINY, **CHANGES})
    run = RunFolder.create(tmp_path / "run")
    with pytest.raises(Interrupted):
        train(city, options, item_device, run)
    resume(city, dataclasses.replace(options, stop_at=0), item_device, run)
    assert model_digest(run) == model_digest(plain_run)


def test_a_record_of_an_earlier_version_lacks_options_that_came_later():
    options = resolve({}, {})
    record = plain(options)
    del record["test_offset"]
    assert not list(differences(record, options))
    other = dataclasses.replace(options, test_offset=3)
    assert list(differences(record, other)) == [("test_offset", 0, 3)]


def test_a_partition_is_the_same_whatever_chose_its_grid():
    one, other = PartitionOptions(), PartitionOptions(block_gaussians=500, expected=900)
    assert not list(differences(plain(one), other))
    assert next(differences(plain(one), PartitionOptions(margin=0.2))) == ("margin", 0.3, 0.2)
