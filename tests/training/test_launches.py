"""What a replayed step enqueues, waits for and allocates."""

from collections import Counter

import numpy as np
import pytest

from clsplat.io.runs.run import RunFolder
from clsplat.schedule.registry import OURS
from clsplat.training.loop import Training
from clsplat.training.step import Step
from tests.data.tiny_training import LEVELLED, STILL, options_of

STEPS = 20
MOST = 20  # launches and fills of a step of the group form
# exposures with vignetting, statistics for growth and harmonics from the second step
# on; each further degree would be other programs with the same launches
ALL_ON = {
    "iterations": STEPS,
    "exposure": "on",
    "vignetting": "on",
    "sh_degree": 1,
    "sh_every": 1,
    "densify_until": 10**6,
    **STILL,
}


@pytest.fixture
def counted(monkeypatch):
    """counted(device, **options): (launches, waits, allocations) of each step of a training, a list
    of options.batch samples' work each."""

    def counted(device, scene, folder, **options):
        found = []

        def noted(step, *arguments):
            before = device.launches, device.waits, device.allocations
            result = run(step, *arguments)
            after = device.launches, device.waits, device.allocations
            found.append(tuple(np.subtract(after, before).tolist()))
            return result

        monkeypatch.setattr(Step, "run", noted)
        training = Training(scene, options_of(**{**ALL_ON, **options}), device, RunFolder.create(folder))
        with training.resumable():
            training.clock.restart()
            while not training.finished():
                training.take_step()
        return found

    run = Step.run
    return counted


def of_a_replay(found):
    """The launches of the steps that neither wait nor allocate: all but a few, and all equal."""
    (common, number), *_ = Counter(found).most_common()
    assert common[1:] == (0, 0) and number > 0.7 * len(found), Counter(found)
    assert {launches for launches, *rest in found if rest == [0, 0]} == {common[0]}
    return common[0]


@pytest.mark.parametrize(
    "schedule, batch, item, group", [*((schedule, 1, 20, 16) for schedule in OURS), ("taming", 2, 64, 56)]
)
@pytest.mark.one_in(12)
def test_a_step_of_every_schedule(float_device, city, tmp_path, counted, schedule, batch, item, group):
    options = {"levels": (1.0,), "reproject": "off"} if schedule == "sig" else {}
    launches = of_a_replay(counted(float_device, city, tmp_path, schedule=schedule, batch=batch, **options))
    # both regularise the gradients of each view, and positions of mcmc take random steps
    more = {"sig": batch, "mcmc": 1 + batch}.get(schedule, 0)
    assert launches == (item if float_device.form == "item" else group) + more
    assert batch > 1 or float_device.form == "item" or launches <= MOST


@pytest.mark.slow
def test_corrected_poses(float_device, city, tmp_path, counted):
    """The corrected camera, the sums of the gradient and the step of the pose."""
    launches = of_a_replay(
        counted(float_device, city, tmp_path, schedule="constant", poses="on", exposure="off", vignetting="off")
    )
    assert launches == (18 if float_device.form == "item" else 14) + 3


@pytest.mark.slow
def test_a_step_with_reprojection(float_device, city, tmp_path, counted):
    """Its weight is another one in each step."""
    launches = of_a_replay(
        counted(
            float_device,
            city,
            tmp_path,
            **{
                **LEVELLED,
                "levels": (1.0,),
                "convergence": "paper",
                "iterations": STEPS,
                "sh_degree": 1,
                "sh_every": 1,
                "reproject": "on",
                "densify_every": 1000,
            },
        )
    )
    assert launches == (24 if float_device.form == "item" else 20)


def test_without_what_is_optional(float_device, city, tmp_path, counted):
    """No exposures."""
    launches = of_a_replay(counted(float_device, city, tmp_path, schedule="constant", exposure="off", vignetting="off"))
    assert launches == (18 if float_device.form == "item" else 14)
