"""The end of a city: one model of its blocks, its levels of detail, and what it scores."""

import dataclasses

from clsplat.city.lod import merge_levels
from clsplat.city.merge import merge, partition_of, seam_table
from clsplat.city.seams import find_seams
from clsplat.city.stages import COARSE_FACTOR, draw
from clsplat.errors import InputError
from clsplat.evaluation.views import evaluate_run, training_pictures
from clsplat.gaussians import Gaussians
from clsplat.io.ply import read_ply
from clsplat.io.run import MODEL, RunFolder
from clsplat.report.page import Table, embedded
from clsplat.report.run import write_report


def check_reference(against):
    """InputError where `against`, of `evaluate_city`, is neither a finished run nor a PLY file."""
    if against is None:
        return
    path = against / MODEL if against.is_dir() else against
    if not path.is_file():
        raise InputError(f"--against {against}: " + (
            f"has no {MODEL}; give a finished run, or a PLY file" if against.is_dir()
            else "no such file; give a PLY file, or a finished run"))
    read_ply(path)


def merge_city(city, scene, options, device, fill=False):
    """Merge the blocks of a CityFolder into its model and levels of detail; returns a `Merged`.

    options: TrainOptions of the whole; fill: see `merge.merge`. InputError, with nothing written,
    where a block is lacking.
    """
    merged = merge(city, scene, fill)
    merged.check()
    run, spent = RunFolder(city.path), cost(city)
    run.write_options({
        "scene": scene.path, **dataclasses.asdict(options),
        "fingerprint": city.read()["fingerprint"], "opencl_device": device.name,
        "kernel_form": device.form, "extent": scene.extent, "offset": scene.offset.tolist(),
        "blocks": len(merged.shares)})
    run.rewind(-1)
    run.log({"event": "merge", **spent, "level": 1.0, "gaussians": merged.gaussians.count,
             **merged.record()})
    run.save_model(merged.gaussians, scene.offset, (f"merged of {len(merged.shares)} blocks",))
    keep_coarse_levels(city, scene)
    merge_levels(city, scene)
    return merged


def keep_coarse_levels(city, scene):
    """Make the coarse model, and what its levels left, levels of detail of the whole."""
    coarse, whole = RunFolder(city.coarse), RunFolder(city.path)
    for factor, path in [*coarse.snapshots(), (1.0, city.coarse / MODEL)]:
        level = COARSE_FACTOR * factor
        whole.save_snapshot(level, plain(read_ply(path, scene.offset)), scene.offset,
                            (f"level {level:g}",))


def evaluate_city(city, scene, options, device, against=None):
    """Score the merged model on the held-out views, look for seams, and write the report.

    against: path of the PLY, or of the run, that seams are measured by; None: the coarse model.
    Returns (scores as of `evaluate_views`, or None without held-out views; seams as of
    `find_seams`, by the training views where none are held out).
    """
    run, merged = RunFolder(city.path), merge_record(city)
    scores = None
    train, test = scene.reduced(options.downscale, options.max_resolution).split(options.test_every)
    if test:
        scores = evaluate_run(run, device, save_images=False)
        means = {key: value for key, value in scores.items()
                 if key not in ("per_view", "pictures")}
        run.log({"event": "eval", **cost(city), "level": 1.0, "gaussians": merged["gaussians"],
                 **means})
    seams, partition = None, partition_of(city, scene)
    if not city.picture.is_file():
        draw(city, partition, scene, [share["gaussians"] for share in merged["blocks"]])
    if len(merged["blocks"]) > 1:
        def model_of(number):
            path = city.block(number).run / MODEL
            return read_ply(path, scene.offset) if path.is_file() else None

        model, reference = run.load_model(), against or city.coarse
        reference = reference / MODEL if reference.is_dir() else reference
        seams = find_seams(
            device, partition, scene, test or train, options, model,
            [share["gaussians"] for share in merged["blocks"]],
            plain(read_ply(reference, scene.offset)), model_of)
        run.log({"event": "seams", **cost(city), "level": 1.0, "gaussians": merged["gaussians"],
                 "seam_db": seams["seam_db"], "worst_seam_db": seams["worst_seam_db"]})
    write_report(run, embedded(city.picture, "map of the blocks"), block_shares(merged),
                 seams and seam_table(seams),
                 pictures=scores["pictures"] if scores else training_pictures(run, device))
    return scores, seams


def block_shares(merged):
    """A Table of the record of a merge."""
    names = ("block", "state", "gaussians", "trained", "views", "points", "note")
    return Table("Blocks", names, [tuple(str(share[name]) for name in names)
                                   for share in merged["blocks"]], range(2, 6))


def merge_record(city):
    """The last record of a merge in the city's metrics."""
    return [record for record in RunFolder(city.path).records() if record["event"] == "merge"][-1]


def cost(city):
    """{iteration, train_seconds, wall_seconds}: sums over the coarse run and the blocks."""
    last = [record for path in (city.coarse, *(block.run for block in city.blocks()))
            if RunFolder(path).has_metrics for record in RunFolder(path).records()[-1:]]
    return {key: round(sum(record.get(key) or 0 for record in last), 3)
            for key in ("iteration", "train_seconds", "wall_seconds")}


def plain(gaussians):
    """The gaussians without spheres."""
    return Gaussians({name: values for name, values in gaussians.rows.items()
                      if name not in ("anchors", "max_offsets")}, gaussians.sh_degree)
