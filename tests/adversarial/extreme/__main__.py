"""Prints the extreme set as a markdown table: `python -m tests.adversarial.extreme [--all]`."""

import argparse

from clsplat.device import Device, list_devices
from tests.adversarial.extreme.cases import CASES, ORDINARY
from tests.adversarial.extreme.city import measure_city
from tests.adversarial.extreme.measure import measure

HEAD = ("case", "expected", "runtime and form", "image", "worst gradient", "bound")


def main():
    parser = argparse.ArgumentParser(
        prog="python -m tests.adversarial.extreme",
        description="The extreme set on every runtime and in both forms, as a markdown table: "
        "largest absolute error of the image, largest relative L2 error of a gradient.")
    parser.add_argument("--all", action="store_true", help="the slow cases and the city too")
    everything = parser.parse_args().all
    devices = [(f"{entry.platform.split()[0]} {form}", entry, form) for entry in list_devices()
               if entry.works for form in ("item", "group")]
    opened = [(label, Device(entry.handle, form=form)) for label, entry, form in devices]
    print_row(HEAD)
    print_row(["---"] * len(HEAD))
    for case in CASES:
        for label, device in opened if everything or not case.slow else ():
            print_errors(case.name, case.outcome, label, measure(device, case), case.image,
                         case.gradient)
    for count in (20_000, 200_000) if everything else ():
        for label, device in opened:
            double = Device(device.handle, precision="double", form="item")
            print_errors(f"city of {count} gaussians", "within bound of double", label,
                         measure_city(device, double, count), ORDINARY, ORDINARY)


def print_errors(name, outcome, label, found, image, gradient):
    field, worst = max(found.gradients.items(), key=lambda item: item[1].value)
    print_row((name, outcome, label, f"{found.image.value:.1e}",
               f"{worst.value:.1e} ({field})" if worst.value else "0",
               f"{image:.0e}" if image == gradient else f"{image:.0e}, {gradient:.0e}"))


def print_row(cells):
    print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
