"""Cities that are damaged, half there, mixed or changed."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import model, same_model
from tests.adversarial.damage import edited, flipped, truncated, without, written

CITY = "clsplat city sy -n 8 --grid 2x1 -q -o city"
MERGE = "clsplat merge city"
BLOCK = "clsplat block parted/blocks/000 -q"
ALL = {"needs": ("sy", "city"), "writes": ("city",)}
PARTED = {"needs": ("sy", "parted"), "writes": ("parted",)}
FIRST = "city/blocks/000"

CASES = [
    *(works(f"city-without-{name}", CITY, same_model("city", "city"),
            setup=f"rm -r {' '.join('city/' + part for part in parts)}", **ALL)
      for name, parts in (
        ("model", ["point_cloud.ply"]), ("picture", ["partition.png"]),
        ("map", ["partition.geojson"]), ("report", ["report.html"]), ("levels", ["lod"]),
        ("block", ["blocks/001"]), ("blocks", ["blocks"]), ("block-run", ["blocks/000/run"]),
        ("block-model", ["blocks/001/run/point_cloud.ply"]), ("metrics", ["metrics.jsonl"]),
        ("coarse", ["coarse"]), ("partition", ["partition.json", "blocks"]))),
    *(refused(f"city-{name}", CITY, says, setup=setup, **ALL) for name, says, setup in (
        ("record-cut", "city.json", truncated("city/city.json", 50)),
        ("record-list", "city.json", written("city/city.json", "[]")),
        ("record-of-other-scene", "scene|city.json", edited("city/city.json", fingerprint="0")),
        ("partition-cut", "partition.json", truncated("city/partition.json", 100)),
        ("partition-list", "partition.json", written("city/partition.json", "[]")),
        ("partition-empty", "partition.json", written("city/partition.json", "{}")))),
    *(either(f"merge-partition-without-{key}", MERGE, setup=without("city/partition.json", key),
             **ALL) for key in ("regions", "views", "asked", "replaces", "frame", "method")),
    *(either(f"merge-record-without-{key}", MERGE, setup=without("city/city.json", key), **ALL)
      for key in ("scene", "options", "fingerprint")),
    refused("merge-scene-elsewhere", MERGE, "/no/such", setup=edited("city/city.json",
            scene="/no/such", scene_absolute="/no/such"), **ALL),
    refused("merge-block-model-cut", MERGE, "000", setup=truncated(
        f"{FIRST}/run/point_cloud.ply", 5000), **ALL),
    refused("merge-block-missing", MERGE, "001", setup="rm -r city/blocks/001", **ALL),
    refused("merge-block-unfinished", MERGE, "001", setup="rm city/blocks/001/run/point_cloud.ply",
            **ALL),
    works("merge-fill-missing", f"{MERGE} --fill", model("city"), setup="rm -r city/blocks/001",
          **ALL),
    either("merge-block-empty-metrics", MERGE, setup=truncated(f"{FIRST}/run/metrics.jsonl", 0),
           **ALL),
    either("merge-coarse-metrics-cut", MERGE, setup=truncated("city/coarse/metrics.jsonl", 30),
           **ALL),
    refused("merge-blocks-swapped", MERGE, "000|001|block", **ALL,
            setup="cd city/blocks; mv 000 x; mv 001 000; mv x 001"),
    refused("merge-block-twice", MERGE, "001|block", **ALL,
            setup="rm -r city/blocks/001; cp -r city/blocks/000 city/blocks/001"),
    either("merge-block-too-many", MERGE, setup="cp -r city/blocks/001 city/blocks/002", **ALL),
    works("merge-stranger-in-blocks", MERGE, same_model("city", "city"),
          setup="mkdir city/blocks/mine; touch city/blocks/notes.txt", **ALL),
    refused("merge-coarse-missing", MERGE, "coarse", setup="rm -r city/coarse", **ALL),
    refused("merge-coarse-unfinished", MERGE, "coarse", setup="rm city/coarse/point_cloud.ply",
            **ALL),
    works("merge-twice", f"{MERGE} && {MERGE}", same_model("city", "city"), **ALL),
    works("merge-after-copy", "cp -r city c2 && rm -r city && clsplat merge c2",
          same_model("c2", "city"), needs=("sy", "city"), writes=("city", "c2")),
    *(refused(f"block-{name}", BLOCK, says, setup=setup, **PARTED) for name, says, setup in (
        ("record-missing", "block.json", "rm parted/blocks/000/block.json"),
        ("record-cut", "block.json", truncated("parted/blocks/000/block.json", 60)),
        ("record-list", "block.json", written("parted/blocks/000/block.json", "[]")),
        ("options-list", "block.json", edited("parted/blocks/000/block.json", options=[])),
        ("options-damaged", "block.json|iterations", edited(
            "parted/blocks/000/block.json", options=lambda o: {**o, "iterations": "x"})),
        ("of-other-partition", "partition", edited("parted/blocks/000/block.json", partition="0")),
        ("of-other-city", "city", edited("parted/blocks/000/block.json", city="0")),
        ("region-missing", "region", "rm parted/blocks/000/region.json"),
        ("region-cut", "region", truncated("parted/blocks/000/region.json", 40)),
        ("region-empty", "region", written("parted/blocks/000/region.json", "{}")),
        ("windows-list", "region", edited("parted/blocks/000/region.json", windows=[])),
        ("windows-outside", "region", edited("parted/blocks/000/region.json", windows=lambda w: {
            name: [0, 0, 9999, 9999] for name in w} or {"001.jpg": [0, 0, 9999, 9999]})),
        ("initial-missing", "initial", "rm parted/blocks/000/initial.ply"),
        ("initial-cut", "initial", truncated("parted/blocks/000/initial.ply", 7000)),
        ("photos-link-nowhere", "jpg", "rm sy/images/001.jpg"),
        ("model-cut", "sparse|points3D", truncated(
            "parted/blocks/000/sparse/0/points3D.bin", 100)))),
    either("block-initial-flipped", BLOCK, setup=flipped("parted/blocks/000/initial.ply", 0.5, 6),
           **PARTED),
    works("block-copied-out", "cp -rL parted/blocks/000 b && clsplat block b -q",
          same_model("b/run", "city/blocks/000/run"), needs=("sy", "parted"), writes=("b",)),
    works("block-through-link", "ln -s parted/blocks/000 b; clsplat block b -q",
          model("parted/blocks/000/run"), needs=("sy", "parted"), writes=("parted", "b")),
    works("block-inside-itself", "cd parted/blocks/000 && clsplat block . -q",
          same_model("parted/blocks/000/run", "city/blocks/000/run"), **PARTED),
    works("block-stopped-and-again", "clsplat block parted/blocks/000 -q --stop-at 3; "
          f"{BLOCK}", same_model("parted/blocks/000/run", "city/blocks/000/run"), **PARTED),
    works("city-goes-on-from-parts", "clsplat partition parted --grid 2x1 && clsplat block "
          "parted/blocks/000 -q && clsplat block parted/blocks/001 -q && clsplat merge parted",
          model("parted"), **PARTED),
    refused("partition-other-method", "clsplat partition city --grid 2x1 --method vastgs",
            "method|cut", needs=("sy", "city"), writes=()),
    refused("partition-mixed", MERGE, "partition|block",
            setup=edited("city/blocks/001/block.json", partition="0"), **ALL),
    works("partition-finished-again", "clsplat partition city --grid 2x1",
          same_model("city", "city"), **ALL),
    either("render-levels-damaged", "clsplat render city --lod --views test -o out",
           needs=("sy", "city"), setup=truncated("city/lod/level_2.ply", 2000)),
    refused("eval-city-model-missing", "clsplat eval city --no-images", "point_cloud.ply",
            setup="rm city/point_cloud.ply", needs=("sy", "city"), writes=()),
    refused("resume-coarse-by-other-scene", "clsplat synth -o sz --blocks 1x1 --views 9 --size "
            "64x64 && clsplat city sz -n 8 --grid 2x1 -q -o city", "scene", needs=("sy", "city"),
            writes=("sz",)),
]
