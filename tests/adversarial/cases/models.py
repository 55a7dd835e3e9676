"""COLMAP models and transforms.json that are damaged, empty or strange."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import model, same_model
from tests.adversarial.damage import camera, flipped, transforms, truncated, written

RUN = "clsplat train sy -n 12 --checkpoint-every 4 -q -o out"
NERF = "clsplat train nerf -n 4 -q --test-every 0 -o out"
FILES = ("cameras", "images", "points3D")
NAN = float("nan")


def of_pose(change):
    """Each frame's matrix, changed in place."""
    def frames(rows):
        for row in rows:
            change(row["transform_matrix"])
        return rows
    return frames


def put(row, column, value):
    def change(matrix):
        matrix[row][column] = value
    return of_pose(change)


def scaled(factor):
    def change(matrix):
        for row in matrix[:3]:
            row[3] *= factor
    return of_pose(change)


def moved(by):
    def change(matrix):
        for row in matrix[:3]:
            row[3] += by
    return of_pose(change)


def first(**values):
    """The first frame's keys replaced."""
    return lambda rows: [{**rows[0], **values}, *rows[1:]]


CASES = [
    *(refused(f"{name}-{kind}", RUN, name, setup=setup)
      for name in FILES for kind, setup in (
          ("empty", truncated(f"sy/sparse/0/{name}.bin", 0)),
          ("cut-in-count", truncated(f"sy/sparse/0/{name}.bin", 5)),
          ("cut-at-end", truncated(f"sy/sparse/0/{name}.bin", -3)),
          ("claims-many", written(f"sy/sparse/0/{name}.bin", b"\xff" * 8 + bytes(60))),
          ("is-text", written(f"sy/sparse/0/{name}.bin", "# no binary\n" * 9)))),
    *(refused(f"{name}-missing", RUN, "sparse|model", setup=f"rm sy/sparse/0/{name}.bin")
      for name in FILES),
    refused("no-points", RUN, "point", setup=written("sy/sparse/0/points3D.bin", bytes(8))),
    refused("no-images", RUN, setup=written("sy/sparse/0/images.bin", bytes(8))),
    *(either(f"{name}-bit-at-{place}", RUN, setup=flipped(f"sy/sparse/0/{name}.bin", place / 100,
                                                         6))
      for name in FILES for place in (3, 40, 77)),
    *(refused(f"camera-{name}", RUN, setup=setup) for name, setup in (
        ("focal-zero", camera(parameters=(0.0, 0.0, 48.0, 32.0))),
        ("focal-nan", camera(parameters=(NAN, 90.0, 48.0, 32.0))),
        ("focal-negative", camera(parameters=(-90.0, -90.0, 48.0, 32.0))),
        ("focal-infinite", camera(parameters=(float("inf"), 90.0, 48.0, 32.0))),
        ("of-no-size", camera(width=0, height=0)), ("of-other-size", camera(width=95)),
        ("unknown-model", camera(kind=99)), ("opencv", camera(4, parameters=(
            90.0, 90.0, 48.0, 32.0, 0.1, 0.0, 0.0, 0.0))),
        ("fisheye", camera(5, parameters=(90.0, 90.0, 48.0, 32.0, 0.0, 0.0, 0.0, 0.0))),
        ("centre-nan", camera(parameters=(90.0, 90.0, NAN, 32.0))))),
    *(either(f"camera-{name}", RUN, setup=setup) for name, setup in (
        ("focal-tiny", camera(parameters=(1e-6, 1e-6, 48.0, 32.0))),
        ("focal-huge", camera(parameters=(1e12, 1e12, 48.0, 32.0))),
        ("centre-outside", camera(parameters=(90.0, 90.0, 4800.0, -3200.0))),
        ("centre-at-corner", camera(parameters=(90.0, 90.0, 0.0, 0.0))),
        ("anamorphic", camera(parameters=(90.0, 9.0, 48.0, 32.0))))),
    works("rigs-damaged", RUN, same_model(), setup=written("sy/sparse/0/rigs.bin", b"\xff" * 30)),
    works("frames-damaged", RUN, same_model(),
          setup=written("sy/sparse/0/frames.bin", b"\xff" * 30)),
    works("two-models", RUN, same_model(), setup="cp -r sy/sparse/0 sy/sparse/1"),
    works("second-model-damaged", RUN, same_model(), setup="mkdir sy/sparse/1; "
          "date > sy/sparse/1/cameras.bin"),
    works("model-in-sparse", RUN, same_model(), setup="mv sy/sparse/0/* sy/sparse; "
          "rmdir sy/sparse/0"),
    works("model-only-in-1", RUN, setup="mv sy/sparse/0 sy/sparse/1"),
    refused("sparse-is-file", RUN, "sparse", setup="rm -r sy/sparse; date > sy/sparse"),
    refused("images-is-file", RUN, "images", setup="rm -r sy/images; date > sy/images"),
    refused("binary-and-text", RUN, setup="rm sy/sparse/0/points3D.bin; "
            "date > sy/sparse/0/points3D.txt"),
    works("geometry-damaged", RUN, same_model(), setup="date > sy/geometry.json"),
    either("geometry-damaged-eval", "clsplat eval run --no-images", needs=("sy", "run"),
           setup="date > sy/geometry.json", writes=("run/metrics.jsonl",)),
    either("geometry-empty-eval", "clsplat eval run --no-images", needs=("sy", "run"),
           setup="echo '{}' > sy/geometry.json", writes=("run/metrics.jsonl",)),
    works("transforms", NERF, model(), setup=transforms()),
    *(refused(f"transforms-{name}", NERF, "transforms|nerf|images|/etc/passwd|/dev/zero",
              setup=setup) for name, setup in (
        ("empty-list", transforms(frames=lambda rows: [])),
        ("one-frame", transforms(frames=lambda rows: rows[:1])),
        ("frame-is-number", transforms(frames=lambda rows: [3, *rows])),
        ("frame-is-null", transforms(frames=lambda rows: [None, *rows])),
        ("frame-twice", transforms(frames=lambda rows: rows + rows[:1])),
        ("pose-nan", transforms(frames=put(0, 3, NAN))),
        ("pose-infinite", transforms(frames=put(1, 3, float("inf")))),
        ("pose-zero", transforms(frames=of_pose(lambda m: [row.__setitem__(
            slice(0, 3), [0, 0, 0]) for row in m]))),
        ("pose-sheared", transforms(frames=put(0, 0, 5.0))),
        ("pose-text", transforms(frames=put(0, 0, "1"))),
        ("pose-ragged", transforms(frames=of_pose(lambda m: m[0].pop()))),
        ("pose-missing", transforms(frames=lambda rows: [{"file_path": "images/000.jpg"}])),
        ("path-number", transforms(frames=first(file_path=7))),
        ("path-empty", transforms(frames=first(file_path=""))),
        ("path-folder", transforms(frames=first(file_path="images"))),
        ("path-null-byte", transforms(frames=first(file_path="images/\0.jpg"))),
        ("path-etc", transforms(frames=first(file_path="/etc/passwd"))),
        ("path-fifo", transforms(frames=first(file_path="/dev/zero"))),
        ("focal-zero", transforms(fl_x=0)), ("focal-text", transforms(fl_x="90")),
        ("focal-nan", transforms(fl_x=NAN)), ("focal-negative", transforms(fl_x=-90)),
        ("focal-missing", transforms(fl_x=None)), ("angle-pi", transforms(
            fl_x=None, camera_angle_x=3.2)),
        ("width-zero", transforms(w=0)), ("width-half", transforms(w=96.5)),
        ("width-other", transforms(w=960)), ("distorted", transforms(k1=0.2)),
        ("k1-nan", transforms(k1=NAN)), ("fisheye", transforms(is_fisheye=True)),
        ("model-unknown", transforms(camera_model="MAGIC")),
        ("centre-infinite", transforms(cx=float("inf"))),
        ("ply-missing", transforms(ply_file_path="nope.ply")),
        ("ply-number", transforms(ply_file_path=3)),
        ("ply-folder", transforms(ply_file_path="images")),
        ("ply-endless", transforms(ply_file_path="/dev/zero")),
        ("ply-photo", transforms(ply_file_path="images/000.jpg")),
        ("turn-scale-nan", transforms(applied_scale=NAN)))),
    *(either(f"transforms-{name}", NERF, setup=setup) for name, setup in (
        ("turn-zero", transforms(applied_transform=[[0] * 4] * 3)),
        ("utm", transforms(frames=moved(5e6))), ("micro", transforms(frames=scaled(1e-6))),
        ("giant", transforms(frames=scaled(1e12))), ("one-place", transforms(frames=scaled(0))),
        ("averted", transforms(frames=of_pose(lambda m: [row.__setitem__(2, -row[2])
                                                         or row.__setitem__(0, -row[0])
                                                         for row in m[:3]]))),
        ("same-poses", transforms(frames=lambda rows: [
            {**row, "transform_matrix": rows[0]["transform_matrix"]} for row in rows])),
        ("two-frames", transforms(frames=lambda rows: rows[:2])),
        ("mirrored", transforms(frames=of_pose(lambda m: [row.__setitem__(0, -row[0])
                                                          for row in m[:3]]))))),
    refused("transforms-duplicate-keys-and-null", NERF, "transforms",
            setup=written("nerf/transforms.json", '{"frames": null, "frames": {}}')),
    refused("transforms-bom-and-comment", NERF, "transforms",
            setup=written("nerf/transforms.json", "\ufeff// frames\n{}")),
    refused("transforms-huge-number", NERF, "transforms",
            setup=written("nerf/transforms.json", '{"frames": [], "w": 1' + "0" * 5000 + "}")),
]
