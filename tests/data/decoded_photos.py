"""HEIC and DNG files, made here: nobody's photos."""

import struct

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

# of EXIF and of GPS, by the numbers of the tags
LENS = {37386: IFDRational(88, 10), 41989: 24, 42036: "wide"}
PLACE = {
    1: "S",
    2: (IFDRational(30), IFDRational(10), IFDRational(1614, 100)),
    3: "E",
    4: (IFDRational(98), IFDRational(5), IFDRational(23526, 1000)),
    5: b"\0",
    6: IFDRational(3189, 10),
}
XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-'
    b'syntax-ns#"><rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/'
    b'1.0/" drone-dji:GimbalPitchDegree="-89.5"/></rdf:RDF></x:xmpmeta>'
)
RGGB = np.array([[0, 1], [1, 2]])
XYZ_TO_SRGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.969266, 1.8760108, 0.041556),
    (0.0556434, -0.2040259, 1.0572252),
)  # linear, D65


def exif_of(model, orientation=1):
    exif = Image.Exif()
    exif.update({271: "Made", 272: model, 274: orientation})
    exif.get_ifd(34665).update(LENS)
    exif.get_ifd(34853).update(PLACE)
    return exif.tobytes()


def write_heic(path, pixels, orientation=1, **options):
    """Write pixels uint8[H, W(, 3 or 4)] losslessly up to the rounding of their colours."""
    import pillow_heif

    pillow_heif.from_pillow(Image.fromarray(pixels)).save(
        path, quality=-1, chroma=444, exif=exif_of("Phone", orientation), xmp=XMP, **options
    )
    return path


def write_dng(path, light, balance=(0.5, 1.0, 0.8), orientation=1, magic=b"*\0", scale=(1, 1)):
    """Write linear light of sRGB, float[H, W, 3], as a camera without a filter for infrared would:
    its colours times the balance of the light, one a pixel, 16 bits. `scale`: of a pixel's
    sides."""
    channel = np.tile(RGGB, (light.shape[0] // 2, light.shape[1] // 2))[..., None]
    mosaic = np.take_along_axis(light * balance * 65535, channel, 2)[..., 0].round()
    tags = {
        271: (2, "Made"),
        272: (2, "Drone"),
        274: (3, orientation),
        700: (1, XMP),
        33421: (3, (2, 2)),
        33422: (1, RGGB.astype(np.uint8).tobytes()),
        50706: (1, b"\1\4\0\0"),
        50708: (2, "Made Drone"),
        50717: (3, 65535),
        50778: (3, 21),
        50718: (5, tuple(map(IFDRational, scale))),
        50721: (10, tuple(IFDRational(round(10**6 * each), 10**6) for row in XYZ_TO_SRGB for each in row)),
        50728: (5, tuple(IFDRational(round(1000 * each), 1000) for each in balance)),
    }
    info = ImageFileDirectory_v2()
    for tag, (kind, value) in tags.items():
        info.tagtype[tag] = kind
        info[tag] = value
    info[34665], info[34853] = LENS, PLACE
    Image.fromarray(mosaic.astype(np.uint16)).save(path, "TIFF", tiffinfo=info)
    data = path.read_bytes()  # Pillow says that black is zero: say that it is a mosaic
    old, new = (struct.pack("<HHII", 262, 3, 1, value) for value in (1, 32803))
    assert data.count(old) == 1 and data.startswith(b"II*\0")
    path.write_bytes(b"II" + magic + data.replace(old, new)[4:])
    return path
