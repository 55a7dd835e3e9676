"""PLY files as a model to render, and to begin with."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import not_black, pictures
from tests.adversarial.damage import COLUMNS, flipped, header, ply, truncated, written

RENDER = "clsplat render m.ply --scene sy --views test -o out"
TRAIN = "clsplat train sy -n 4 -q --init m.ply -o out"
NAN = float("nan")
BAD = {
    "empty": written("m.ply", ""), "magic-only": written("m.ply", "ply\n"),
    "no-end": written("m.ply", header(8).replace(b"end_header\n", b"")),
    "long-comment-line": written("m.ply", b"ply\ncomment " + b"x" * 9_000_000),
    "many-comments": written("m.ply", b"ply\n" + b"comment x\n" * 900_000),
    "count-negative": ply(head=header(-1)), "count-text": ply(head=header("many")),
    "count-float": ply(head=header("8.0")), "count-too-many": ply(head=header(9)),
    "count-2^63": ply(head=header(2**63)), "rows-missing": ply(head=header(10**9)),
    "column-twice": ply(columns=[*COLUMNS, "x"]), "no-opacity": ply(columns=COLUMNS[:9]),
    "points-only": ply(columns=["x", "y", "z"]), "mesh": written(
        "m.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
    "harmonics-of-no-degree": ply(columns=[*COLUMNS, *(f"f_rest_{i}" for i in range(7))]),
    "list-column": written("m.ply", header(1).replace(b"property float x", b"property list uchar "
                                                      b"float x") + bytes(99)),
    "kind-unknown": ply(head=header(8, kind="quad")),
    "nothing": ply(count=0), "positions-nan": ply(x=NAN), "positions-infinite": ply(y=float("inf")),
    "opacity-nan": ply(opacity=NAN), "scale-nan": ply(scale_1=NAN), "turn-nan": ply(rot_2=NAN),
    "colour-nan": ply(f_dc_0=NAN), "html": written("m.ply", "<html>404</html>"),
    "gzip": "gzip -c run/point_cloud.ply > m.ply", "cut": "head -c 99999 run/point_cloud.ply > "
    "m.ply", "folder": "mkdir m.ply", "link-to-nothing": "ln -s nowhere m.ply"}
ODD = {
    "scale-88": ply(scale_0=88.8), "scale-1000": ply(scale_0=1e3, scale_1=1e3, scale_2=1e3),
    "scale-minus-1000": ply(scale_0=-1e3), "scale-infinite": ply(scale_0=float("inf")),
    "scale-minus-infinite": ply(scale_0=float("-inf")), "opacity-infinite": ply(
        opacity=float("inf")), "opacity-huge": ply(opacity=3e38), "turn-zero": ply(rot_0=0),
    "turn-huge": ply(rot_0=3e38, rot_1=3e38), "turn-denormal": ply(rot_0=1e-45),
    "positions-huge": ply(x=3e38, y=3e38, z=3e38), "positions-same": ply(count=900, x=0.0),
    "colour-huge": ply(f_dc_0=3e38), "one": ply(count=1), "two": ply(count=2),
    "bytes-after": ply(tail=b"x" * 999), "elements-after": "cp run/point_cloud.ply m.ply; "
    "echo more >> m.ply", "flipped-1": None, "flipped-2": None}

for _number, _place in ((1, 0.3), (2, 0.8)):
    def _damaged(folder, place=_place):
        (folder / "m.ply").write_bytes((folder / "run/point_cloud.ply").read_bytes())
        flipped("m.ply", place, 6)(folder)
    ODD[f"flipped-{_number}"] = _damaged

CASES = [
    *(refused(f"render-{name}", RENDER, "m.ply", setup=setup, needs=("sy", "run"),
              quick=name == "count-too-many", seconds=30) for name, setup in BAD.items()),
    *(refused(f"init-{name}", TRAIN, "m.ply", setup=setup, needs=("sy", "run"), seconds=30)
      for name, setup in BAD.items() if name in ("empty", "count-2^63", "no-opacity", "nothing",
                                                 "positions-nan", "mesh", "cut", "folder")),
    *(either(f"render-{name}", RENDER, setup=setup, needs=("sy", "run"))
      for name, setup in ODD.items()),
    *(either(f"init-{name}", TRAIN, setup=setup, needs=("sy", "run"))
      for name, setup in ODD.items() if name in ("scale-1000", "positions-huge", "positions-same",
                                                 "turn-zero", "two", "opacity-infinite")),
    works("render-good", RENDER, pictures(2), not_black(), setup=ply(count=200, opacity=3.0),
          quick=True),
    works("render-copied-model", RENDER, pictures(2), not_black(), needs=("sy", "run"),
          setup="cp run/point_cloud.ply m.ply"),
    refused("run-model-cut", "clsplat eval run", "point_cloud.ply", needs=("sy", "run"),
            setup=truncated("run/point_cloud.ply", -100), writes=()),
    refused("export-model-cut", "clsplat export run -o out.ply", "point_cloud.ply",
            needs=("sy", "run"), setup=truncated("run/point_cloud.ply", -100), writes=()),
    refused("export-model-empty", "clsplat export run -o out.ply", "point_cloud.ply",
            needs=("sy", "run"), setup=ply("run/point_cloud.ply", count=0), writes=()),
    refused("export-all-faint", "clsplat export run -o out.ply",
            needs=("sy", "run"), setup=ply("run/point_cloud.ply", opacity=-30.0), writes=()),
]
