"""Strange paths, names and links."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import model, pictures, same_model, there
from tests.adversarial.damage import written

RUN = "-n 12 --checkpoint-every 4 -q"  # as the prepared run's
NAMES = {  # name of a scene's or a run's folder
    "blank": "a b", "quote": "a'b", "double-quote": 'a"b', "dollar": "a$HOME b", "star": "a*b",
    "newline": "a\nb", "tab": "a\tb", "percent": "a%sb%d", "brace": "a{0}b{x}",
    "bracket": "a[0-9]b", "angle": "<script>alert(1)<", "hash": "a#b?c=d", "dash": "--output",
    "unicode": "Zürich 東京 🗼", "right-to-left": "\u202eabc", "decomposed": "u\u0308",
    "mathtext": "$\\frac{$", "backslash": "a\\b", "dots": "...", "colon": "C:", "npz": "sy.npz",
    "long": "n" * 240}


def quoted(name):
    """For bash, whatever is in it."""
    return "'" + f"./{name}".replace("'", "'\\''") + "'"


CASES = [
    *(works(f"scene-{key}", f"clsplat train {quoted(name)} {RUN} -o out", same_model(),
            setup=f"mv sy {quoted(name)}", quick=key == "unicode") for key, name in NAMES.items()),
    *(works(f"run-{key}", f"clsplat train sy {RUN} -o {quoted(name)} && clsplat eval "
            f"{quoted(name)} && clsplat compare {quoted(name)}", there(f"{name}/compare.html"),
            same_model(name), writes=(name,)) for key, name in NAMES.items()
      if key in ("newline", "percent", "brace", "bracket", "angle", "hash", "unicode", "mathtext",
                 "backslash", "long")),
    *(works(f"city-{key}", f"clsplat city {quoted(name)} -n 8 --grid 2x1 -q",
            same_model(f"{name}.city", "city"), setup=f"mv sy {quoted(name)}",
            writes=(f"{name}.city",))
      for key, name in NAMES.items() if key in ("bracket", "unicode", "newline")),
    works("not-utf8", f"clsplat train $'s\\xff' {RUN} -o $'o\\xff'", setup="mv sy $'s\\xff'",
          writes=("o\udcff",)),
    works("scene-is-current-folder", f"cd sy && clsplat train . {RUN} -o ../out", same_model()),
    works("scene-is-parent", f"cd sy/images && clsplat train .. {RUN} -o ../../out", same_model()),
    works("city-current-folder", "cd sy && clsplat city . -n 8 --grid 2x1 -q",
          writes=("sy.city",)),
    works("slash-at-end", f"clsplat train sy/ {RUN} -o out/ && clsplat eval out/", same_model()),
    works("double-slash", f"clsplat train .//sy//. {RUN} -o .//out//.", same_model()),
    works("scene-is-link", f"clsplat train link {RUN} -o out", same_model(), setup="ln -s sy link"),
    works("output-is-link", f"clsplat train sy {RUN} -o link", same_model("real"),
          setup="mkdir real; ln -s real link", writes=("real",)),
    refused("output-is-dead-link", f"clsplat train sy {RUN} -o link", "link",
            setup="ln -s nowhere link"),
    refused("output-is-link-to-itself", f"clsplat train sy {RUN} -o link", "link",
            setup="ln -s link link"),
    refused("scene-is-link-to-itself", f"clsplat train link {RUN} -o out", "link",
            setup="ln -s link link"),
    refused("photos-link-to-themselves", f"clsplat train sy {RUN} -o out", "003.jpg",
            setup="cd sy/images; rm 003.jpg; ln -s 003.jpg 003.jpg"),
    works("photos-are-links", f"clsplat train sy {RUN} -o out", same_model(),
          setup="mv sy/images real; mkdir sy/images; cd sy/images; ln -s ../../real/* ."),
    works("photos-are-hard-links", f"clsplat train sy {RUN} -o out", same_model(),
          setup="mv sy/images real; mkdir sy/images; ln real/* sy/images"),
    refused("photo-is-folder", f"clsplat train sy {RUN} -o out", "003.jpg",
            setup="rm sy/images/003.jpg; mkdir sy/images/003.jpg"),
    refused("photo-is-fifo", f"clsplat train sy {RUN} -o out", "003.jpg",
            setup="rm sy/images/003.jpg; mkfifo sy/images/003.jpg", seconds=30),
    refused("photo-is-endless", f"clsplat train sy {RUN} -o out", "003.jpg",
            setup="ln -sf /dev/zero sy/images/003.jpg", seconds=30),
    refused("points-are-endless", f"clsplat train sy {RUN} -o out", "points3D",
            setup="ln -sf /dev/zero sy/sparse/0/points3D.bin", seconds=30),
    refused("cameras-are-fifo", f"clsplat train sy {RUN} -o out", "cameras",
            setup="rm sy/sparse/0/cameras.bin; mkfifo sy/sparse/0/cameras.bin", seconds=30),
    refused("init-is-fifo", "mkfifo f; clsplat train sy -n 4 -o out --init f",
            writes=("f", "out"), seconds=30),
    refused("render-endless-ply", "clsplat render /dev/zero --scene sy -o out", "/dev/zero",
            seconds=30),
    refused("options-are-fifo", "clsplat eval run", needs=("sy", "run"),
            setup="rm run/options.json; mkfifo run/options.json", seconds=30),
    works("overwrite-follows-no-link", "clsplat train sy -n 4 -q -o run --overwrite",
          there("pics/sub/a.png"), needs=("sy", "run"), writes=("run",),
          setup="mkdir -p pics/sub; rm -rf run/renders; echo x > pics/sub/a.png; "
                "ln -s ../pics run/renders"),
    works("overwrite-follows-no-link-of-levels", "clsplat train sy -n 4 -q -o run --overwrite",
          there("pics/level_2.ply"), needs=("sy", "run"), writes=("run",),
          setup="mkdir pics; echo x > pics/level_2.ply; ln -s ../pics run/lod"),
    works("overwrite-keeps-others", "clsplat train sy -n 4 -q -o run --overwrite",
          there("run/notes.txt", "run/renders/mine.png", "run/renders/test/mine.png",
                "run/lod/mine.ply", "run/sub/model.ply"), needs=("sy", "run"), writes=("run",),
          setup="mkdir -p run/renders/test run/lod run/sub; touch run/notes.txt "
                "run/renders/mine.png run/renders/test/mine.png run/lod/mine.ply "
                "run/sub/model.ply"),
    works("model-is-link", "clsplat train sy -n 4 -q -o run --overwrite", there("mine.ply"),
          model("run"), needs=("sy", "run"), writes=("run",),
          setup="mv run/point_cloud.ply mine.ply; ln -s ../mine.ply run/point_cloud.ply"),
    works("part-is-link", "clsplat train sy -o half --resume -q", same_model("half"),
          setup="echo mine > mine; ln -s ../mine half/point_cloud.ply.part",
          needs=("sy", "half"), writes=("half",)),
    works("part-was-left", "clsplat train sy -o half --resume -q", same_model("half"),
          setup="echo old > half/point_cloud.ply.part; echo old > half/checkpoint.npz.part",
          needs=("sy", "half"), writes=("half",)),
    either("part-is-folder", "clsplat train sy -o half --resume -q",
           setup="mkdir half/checkpoint.npz.part", needs=("sy", "half"), writes=("half",)),
    either("report-is-folder", "clsplat train sy -o half --resume -q", same_model("half"),
           setup="mkdir half/report.html", needs=("sy", "half"), writes=("half",)),
    either("renders-is-file", "clsplat eval run", setup="rm -rf run/renders; echo x > run/renders",
           needs=("sy", "run"), writes=()),
    either("renders-is-link", "clsplat eval run", setup="rm -rf run/renders; mkdir pics; "
           "ln -s ../pics run/renders", needs=("sy", "run"), writes=("pics", "run/metrics.jsonl")),
    works("render-into-scene", "clsplat render run -o sy/images --views test", needs=("sy", "run"),
          writes=("sy/images/000.jpg.png", "sy/images/008.jpg.png")),
    works("render-over-own", "clsplat render run -o out --views test", pictures(3),
          needs=("sy", "run"), setup="mkdir out; cp run/renders/*/*.png out/mine.png || "
          "python -c \"from PIL import Image; Image.new('RGB', (4, 4)).save('out/mine.png')\""),
    works("deep-output", f"clsplat train sy {RUN} -o {'d/' * 60}out", model("d/" * 60 + "out"),
          writes=("d",)),
    either("path-of-4000", "clsplat train sy -n 4 -q -o $(printf 'd%.0s/%.0s' {1..1900})out",
           writes=("d",)),
    refused("path-of-9000", "clsplat train sy -n 4 -q -o $(printf 'dd%.0s/' {1..3000})out"),
    refused("name-of-300", "clsplat train sy -n 4 -q -o " + "n" * 300),
    works("moved-run", "mv run elsewhere && clsplat eval elsewhere --no-images",
          needs=("sy", "run"), writes=("run", "elsewhere")),
    works("moved-both", "mkdir other && mv run sy other && clsplat eval other/run --scene other/sy "
          "--no-images", needs=("sy", "run"), writes=("run", "sy", "other")),
    refused("moved-scene", "mv sy elsewhere && clsplat eval run --no-images", "--scene",
            needs=("sy", "run"), writes=("sy", "elsewhere")),
    works("moved-city", "mv city elsewhere && clsplat merge elsewhere", model("elsewhere"),
          needs=("sy", "city"), writes=("city", "elsewhere")),
    works("block-elsewhere", "cp -rL city/blocks/001 b && rm -r b/run && clsplat block b -q",
          same_model("b/run", "city/blocks/001/run"), needs=("sy", "city"), writes=("b",)),
    works("block-at-root", "D=$(mktemp -d -p /); cp -rL city/blocks/001/. $D; rm -r $D/run; "
          "clsplat block $D -q; E=$?; mv $D/run out; rm -r $D; exit $E", model(),
          needs=("sy", "city")),
    refused("view-leaves-renders", "clsplat eval run", needs=("sy", "run"),
            setup=written("sy/sparse/0/images.bin", b"\1\0\0\0\0\0\0\0" + b"\0" * 64
                          + b"\1\0\0\0../../../evil.jpg\0" + b"\0" * 8), writes=()),
]
