"""The second round of a city: its blocks once more, each under its neighbours' finished models.

In the first round what surrounds a block is as coarse as the scaffold, and what the block has
beside its border learns to make up for that. The second round is a city of the same blocks in
CITY/refined, whose scaffold is the merged model of the first. Nothing grows in it.
"""

import dataclasses

from clsplat.city.stages import begin, cut_into_blocks
from clsplat.io.city import REPLACES
from clsplat.io.run import RunFolder
from clsplat.merge import merge
from clsplat.options import seconds_of


def refining_options(options, share):
    """TrainOptions of the whole for a second round of `share` of the steps: at full size, with
    gaussians that stay as many as they are."""
    schedules = {known.name: known.default for known in dataclasses.fields(options)
                 if known.metadata["only"]}  # what means nothing to the schedule that is none
    budget = f"{share * seconds_of(options.time_budget):g}" if options.time_budget else ""
    iterations = (options.iterations if budget else max(1, round(share * options.iterations)))
    return dataclasses.replace(
        options, **schedules, schedule="constant", iterations=iterations, time_budget=budget,
        densify_until=1, reset_every=0, max_gaussians=0, eval_at=(), eval_every=0, stop_at=0)


def cut_again(city, scene, options, share, device, fill=False):
    """Make the second round's city of a CityFolder whose blocks are trained, and its blocks.

    options: TrainOptions of the whole; share: of the first round's steps; fill: see `merge.merge`.
    What is there already stays as it is. Returns what `cut_into_blocks` does. InputError, with
    nothing written, where a block is lacking.
    """
    again, options = city.refined, refining_options(options, share)
    if not again.has_partition:
        merged = merge(city, scene, fill)
        merged.check()
        begin(again, scene, options)
        coarse, scaffold = RunFolder(city.coarse), RunFolder(again.coarse)
        scaffold.path.mkdir(exist_ok=True)
        scaffold.write_options(coarse.read_options())
        exposures = coarse.load_exposures()
        if exposures is not None:
            scaffold.save_exposures(exposures)
        scaffold.save_model(merged.gaussians, scene.offset, ("the first round's",))
        partition = {**city.read_partition(), "round": 2}  # its blocks are not those of the first
        partition.pop(REPLACES, None)
        again.write_partition(partition)
    begin(again, scene, options)
    return cut_into_blocks(again, scene, options, None, device)
