"""The first steps launch kernels that threads have compiled, and all of these."""

import threading

import pytest

from clsplat.device import Device
from clsplat.device import device as device_module
from clsplat.device.programs import build
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_training import CITY, trained


@pytest.mark.slow
@pytest.mark.parametrize("form", ["item", "group"])
@pytest.mark.parametrize(
    "options, others",
    [
        ({}, set()),
        ({"exposure": "on", "vignetting": "on"}, {"exposure.cl"}),
        ({"poses": "on"}, {"pose.cl"}),
        ({"robust": "on"}, set()),
    ],
    ids=str,
)
@pytest.mark.one_in(8)
def test_all_programs_of_the_first_steps_are_compiled_by_threads(
    item_device, tmp_path, monkeypatch, form, options, others
):
    device, compiled = Device(item_device.handle, form=form), set()

    def noted(context, handle, source, choices, contracts):
        if threading.current_thread() is threading.main_thread():
            compiled.add(contracts[0].kernel.file)
        return build(context, handle, source, choices, contracts)

    monkeypatch.setattr(device_module, "build", noted)
    trained(
        tmp_path / "run",
        read_scene(CITY),
        device,
        **{"iterations": 100, "exposure": "off", "init": "sfm", "sh_every": 1000, "grow_threshold": 1e-6, **options},
    )
    assert compiled <= others and not device._ahead
