"""A scene written as the projects of other programs, so that reading it back can be compared.

Formats are those that `io/scenes/projects/opensfm.py` and `metashape.py` name.
"""

from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from tests.data.layouts import put_photo, world_points, write_json


def stored(view):
    """(width, height), (fx, fy, cx, cy), (k1, k2, k3, k4), (p1, p2) of a photo as it is stored, in
    OpenCV's order, and whether it is a fisheye."""
    if view.lens is None:
        camera = view.camera
        return (camera.width, camera.height), (*camera.focal, *camera.centre), [0.0] * 4, [0, 0], 0
    pinhole, rest = view.lens.parameters[:4], list(view.lens.parameters[4:])
    if "FISHEYE" in view.lens.model:
        if view.lens.model == "THIN_PRISM_FISHEYE":
            k1, k2, p1, p2, k3, k4, *_ = rest
            return view.lens.size, pinhole, [k1, k2, k3, k4], [p1, p2], 1
        return view.lens.size, pinhole, rest, [0.0, 0.0], 1
    k1, k2, p1, p2, k3 = (*rest, 0.0)[:5]
    return view.lens.size, pinhole, [k1, k2, k3, 0.0], [p1, p2], 0


def position(scene, view):
    return view.camera.position + scene.offset


def put_photos(folder, scene):
    for view in scene.views:
        put_photo(view, folder / view.name)


def write_opensfm(folder, scene, reference=None):
    """reconstruction.json with one camera for all, and tracks.csv; the table that was written."""
    put_photos(folder / "images", scene)
    (width, height), (fx, fy, cx, cy), k, p, fisheye = stored(scene.views[0])
    longer = max(width, height)
    camera = {
        "projection_type": "fisheye_opencv" if fisheye else "brown",
        "width": width,
        "height": height,
        "focal_x": fx / longer,
        "focal_y": fy / longer,
        "c_x": (cx - width / 2) / longer,
        "c_y": (cy - height / 2) / longer,
        **{f"k{number + 1}": value for number, value in enumerate(k)},
        "p1": p[0],
        "p2": p[1],
    }
    shots = {
        view.name: {
            "camera": "v2 made",
            "translation": (-view.camera.rotation @ position(scene, view)).tolist(),
            "rotation": Rotation.from_matrix(view.camera.rotation).as_rotvec().tolist(),
        }
        for view in scene.views
    }
    points = {
        f"{number}": {"coordinates": point.tolist(), "color": colour.tolist()}
        for number, (point, colour) in enumerate(zip(world_points(scene), scene.colours))
    }
    table = {"cameras": {"v2 made": camera}, "shots": shots, "points": points}
    if reference is not None:
        table["reference_lla"] = dict(zip(("latitude", "longitude", "altitude"), reference))
    write_json(folder / "reconstruction.json", [table])
    if scene.observations is not None:
        rows = [
            f"{scene.views[view].name}\t{point}\t0\t0.1\t0.2\t0.01\t1\t2\t3\t-1\t-1"
            for point, view in scene.observations.tolist()
        ]
        (folder / "tracks.csv").write_text("\n".join(["OPENSFM_TRACKS_VERSION_v2", *rows, ""]))
    return table


def texts(values):
    return " ".join(repr(float(value)) for value in np.ravel(values))


def write_metashape(folder, scene, transform=None, reference="", extra="", label=None, component=True):
    """cameras.xml.

    transform: (scale, rotation, translation) of the component or the chunk; extra: more
    coefficients; label: what a photo is called, a function of its view's name.
    """
    put_photos(folder / "images", scene)
    scale, rotation, translation = transform or (1.0, np.eye(3), np.zeros(3))
    (width, height), (fx, fy, cx, cy), k, p, fisheye = stored(scene.views[0])
    kind = "fisheye" if fisheye else "frame"
    values = {
        "f": fy,
        "b1": fx - fy,
        "cx": cx - width / 2,
        "cy": cy - height / 2,
        "k1": k[0],
        "k2": k[1],
        "k3": k[2],
        "k4": k[3],
        "p1": p[1],
        "p2": p[0],
    }
    lines = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items() if value)
    placed = (
        f'<transform><rotation locked="true">{texts(rotation)}</rotation><translation>'
        f"{texts(translation)}</translation><scale>{scale!r}</scale></transform>"
    )
    cameras = []
    for number, view in enumerate(scene.views):
        pose = np.eye(4)
        pose[:3, :3] = rotation.T @ view.camera.rotation.T
        pose[:3, 3] = rotation.T @ (position(scene, view) - translation) / scale
        name = quoteattr(view.name if label is None else label(view.name))
        cameras.append(
            f'<camera id="{number}" sensor_id="0" component_id="0" label={name}>'
            f"<transform>{texts(pose)}</transform></camera>"
        )
    group = f'<group id="0" label="g">{cameras.pop()}</group>'
    within = f'<component id="0" label="Component 1">{placed if component else ""}</component>'
    (folder / "cameras.xml").write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
 <sensors next_id="1"><sensor id="0" label="made" type="{kind}">
  <resolution width="{width}" height="{height}"/>
  <calibration type="{kind}" class="adjusted"><resolution width="{width}" height="{height}"/>
   {lines}{extra}</calibration></sensor></sensors>
 <components next_id="1" active_id="0">{within}</components>
 <cameras next_id="9" next_group_id="1">{"".join(cameras)}{group}</cameras>
 <reference>{reference}</reference>{"" if component else placed}
</chunk></document>
"""
    )
    return folder / "cameras.xml"
