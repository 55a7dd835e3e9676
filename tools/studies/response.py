"""Train scenes with and without exposures; print what each rule for held-out photos gives.

    python -m tools.studies.response OUT SCENE ... [--vignetting on] [--tone on] [--exposure on]

A division holds out every 8th photo from an offset on. The rules: the model without any response,
as it is exported; the identity as transform; the mean of all training photos' transforms; the
interpolation between those before and after; the one that is used
(clsplat/evaluation/held_out_responses.py); and the mean of the four nearest cameras, weighted by
the inverse of their squared distance. Finished runs in OUT are used again.
"""

import argparse
import dataclasses
import functools
from pathlib import Path

import numpy as np

import clsplat
from clsplat.device import choose_device
from clsplat.evaluation.colour import fit_colour
from clsplat.evaluation.held_out_responses import interpolated, predicted_responses
from clsplat.evaluation.metrics import psnr
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import opened, photo_of, render_view
from clsplat.io.runs.run import RunFolder
from clsplat.loss.exposure import Exposures
from clsplat.response import Response
from clsplat.training import session

EVERY = 8
NEAREST = 4
RULES = ("model", "identity", "mean", "interpolated", "used", "nearest")


def main(argv=None):
    """Train what is missing and print a row for each division."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--offsets", type=int, nargs="+", default=[0, 3, 6])
    parser.add_argument("--iterations", type=int, default=800)
    parser.add_argument("--downscale", type=float, default=8.0)
    parser.add_argument("--rate", type=float, default=5e-3, help="of exposures: a short training "
                        "gives a photo few steps")
    parser.add_argument("--schedule", default="sig")
    parser.add_argument("--vignetting", default="off")
    parser.add_argument("--tone", default="off")
    parser.add_argument("--exposure", nargs="+", default=["off", "on"], help="on: leaves out the "
                        "training without exposures")
    options = parser.parse_args(argv)
    session.Exposures = functools.partial(Exposures, rate=options.rate)
    device = choose_device("auto")
    print("| scene, offset | off: plain | cc | on: cc | "
          + " | ".join(RULES) + " | weight | a, b |")
    print("|---" * (6 + len(RULES)) + "|")
    for path in options.scenes:
        whole = clsplat.Scene.read(path)
        for offset in options.offsets:
            held_out = frozenset(view.name for view in whole.views[offset::EVERY])
            scene = dataclasses.replace(whole, held_out=held_out)
            numbers = division(options, device, scene, f"{path.name}-{offset}")
            print(f"| {path.name} {offset} | " + " | ".join(f"{n:.2f}" for n in numbers[:-2])
                  + f" | {numbers[-2]:.2f}, {numbers[-1]:.2f} |",
                  flush=True)


def division(options, device, scene, name):
    """The numbers of a row, dB, the weight, and the bends of the first lens."""
    small = scene.reduced(options.downscale)
    train, test = small.split(EVERY)
    photos = [photo_of(view) for view in test]
    numbers = []
    for exposure in ("off", "on"):
        if exposure not in options.exposure:
            numbers += [np.nan, np.nan]
            continue
        learned = {"vignetting": options.vignetting, "tone": options.tone}
        folder = options.out / "-".join([name, options.schedule, exposure, *learned.values()])
        run = Run(RunFolder(folder))
        if not run.is_finished:
            run = clsplat.train(
                scene, folder, device=device, overwrite=True, iterations=options.iterations,
                downscale=options.downscale, schedule=options.schedule, exposure=exposure,
                eval_every=0, **(learned if exposure == "on" else {}))
        model = opened(device, run.finished_model, small, run.options)
        renders = [render_view(*model, view.camera) for view in test]
        if exposure == "off":
            numbers.append(mean_psnr(renders, photos))
            numbers.append(mean_psnr(map(fit_colour, renders, photos), photos))
    learned = run.folder.load_exposures()
    rules, weight = responses_of(small, train, test, learned)
    shown = {rule: [np.clip(response.applied(render, view.camera), 0, 1)
                    for render, view, response in zip(renders, test, responses)]
             for rule, responses in rules.items()}
    fitted = map(fit_colour, shown["identity"], photos)
    return [*numbers, mean_psnr(fitted, photos),
            *(mean_psnr(shown[rule], photos) for rule in RULES), weight,
            *learned[train[0].name].tone]


def responses_of(scene, train, test, learned):
    """Rule -> the responses of the held-out views; and the weight of the one that is used."""
    used = predicted_responses(scene.views, learned)
    names = [view.name for view in scene.views]
    places = np.array([names.index(view.name) for view in train])
    known = np.array([learned[view.name].transform for view in train])
    positions = np.array([view.camera.position for view in train])

    def of(transform, view):
        return dataclasses.replace(used.responses[view.name], transform=transform)

    def nearest(view):
        distances = np.linalg.norm(positions - view.camera.position, axis=1)
        near = np.argsort(distances)[:NEAREST]
        return np.average(known[near], axis=0, weights=distances[near]**-2)

    return {"model": [Response() for _ in test],
            "identity": [of(np.eye(3, 4), view) for view in test],
            "mean": [of(known.mean(axis=0), view) for view in test],
            "interpolated": [of(interpolated(names.index(view.name), places, known), view)
                             for view in test],
            "used": [used.responses[view.name] for view in test],
            "nearest": [of(nearest(view), view) for view in test]}, used.weight


def mean_psnr(images, photos):
    """The mean over views, dB."""
    return float(np.mean([psnr(image, photo) for image, photo in zip(images, photos)]))


if __name__ == "__main__":
    main()
