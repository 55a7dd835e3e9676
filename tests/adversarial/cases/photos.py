"""Photos that are not what their name says, or not what training wants."""

import io

from PIL import Image, ImageOps

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import evaluated, model, same_model
from tests.adversarial.damage import PHOTO, flipped, photo, photos, truncated, written

RUN = "clsplat train sy -n 12 --checkpoint-every 4 -q -o out"
NAME = "003.jpg"


def encoded(form, mode="RGB", size=(96, 64), **how):
    """A function that gives the bytes of a picture of one colour."""
    def data():
        buffer = io.BytesIO()
        Image.new(mode, size).save(buffer, form, **how)
        return buffer.getvalue()
    return data


CASES = [
    *(refused(f"photo-cut-{place}", RUN, NAME, setup=truncated(PHOTO, place))
      for place in (0, 1, 2, 20, 300, 1500)),
    refused("photo-cut-near-end", RUN, NAME, setup=truncated(PHOTO, -40)),
    refused("photo-is-text", RUN, NAME, setup=written(PHOTO, "not a picture\n")),
    refused("photo-is-html", RUN, NAME, setup=written(PHOTO, "<html>404 Not Found</html>")),
    refused("photo-is-lfs-pointer", RUN, NAME, setup=written(
        PHOTO, "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 4\n")),
    refused("photo-is-svg", RUN, NAME, setup=written(
        PHOTO, '<svg xmlns="http://www.w3.org/2000/svg" width="96" height="64"/>')),
    refused("photo-is-zeros", RUN, NAME, setup=written(PHOTO, bytes(4000))),
    refused("photo-is-zip", RUN, NAME, setup=written(PHOTO, b"PK\3\4" + bytes(400))),
    refused("photo-is-ply", RUN, NAME, setup=f"cp run/point_cloud.ply {PHOTO}",
            needs=("sy", "run")),
    works("photo-is-png-inside", RUN, model(), setup=written(PHOTO, encoded("PNG"))),
    works("photo-is-webp-inside", RUN, model(), setup=written(PHOTO, encoded("WEBP"))),
    either("photo-is-gif-of-frames", RUN, setup=written(PHOTO, encoded(
        "GIF", "P", save_all=True, append_images=[Image.new("P", (96, 64), 3)]))),
    either("photo-is-pdf", RUN, setup=written(PHOTO, encoded("PDF"))),
    either("photo-is-ico", RUN, setup=written(PHOTO, encoded("ICO", size=(64, 64)))),
    *(refused(f"photo-of-{w}x{h}", RUN, NAME, setup=photo(size=(w, h)))
      for w, h in ((1, 1), (64, 96), (97, 64), (96, 128), (192, 64), (95, 63))),
    either("photo-twice-as-large", RUN, setup=photo(size=(192, 128))),
    refused("photo-bomb", RUN, NAME, setup=written(PHOTO, encoded("PNG", "1", (30000, 30000)))),
    either("photo-grey", RUN, setup=photo("L")),
    either("photo-16-bits", RUN, setup=photo("I;16", format="PNG")),
    either("photo-float", RUN, setup=photo("F", format="TIFF")),
    either("photo-palette-with-alpha", RUN, setup=written(PHOTO, encoded(
        "PNG", "P", transparency=0))),
    either("photo-grey-alpha", RUN, setup=written(PHOTO, encoded("PNG", "LA"))),
    either("photo-rgba", RUN, setup=written(PHOTO, encoded("PNG", "RGBA"))),
    either("photo-cmyk", RUN, setup=photo("CMYK")),
    either("photo-lab", RUN, setup=photo("LAB", format="TIFF")),
    either("photo-hsv", RUN, setup=written(PHOTO, encoded("JPEG", "YCbCr"))),
    works("photo-with-strange-profile", RUN, model(), setup=photo(icc_profile=b"not a profile")),
    works("photo-with-broken-exif", RUN, model(), setup=photo(exif=b"Exif\0\0II*\0\xff\xff\xff")),
    works("photo-with-long-comment", RUN, model(), setup=photo(comment=b"x" * 60000)),
    works("photo-with-bytes-after-end", RUN, same_model(),
          setup=f"head -c 5000 /dev/urandom >> {PHOTO}"),
    refused("photo-missing", RUN, NAME, setup=f"rm {PHOTO}", quick=True),
    refused("photos-missing", RUN, "images", setup="rm -r sy/images"),
    refused("photos-none", RUN, "000.jpg", setup="rm sy/images/*"),
    refused("photo-in-capitals", RUN, NAME, setup="mv sy/images/003.jpg sy/images/003.JPG"),
    works("photo-not-in-model", RUN, same_model(), setup="cp sy/images/003.jpg sy/images/aaa.jpg"),
    works("thumbs-beside", RUN, same_model(),
          setup="touch sy/images/Thumbs.db sy/images/.DS_Store sy/images/._003.jpg; "
                "mkdir sy/images/@eaDir"),
    either("photos-all-black", RUN, setup=photos(lambda image: image.point(lambda value: 0))),
    either("photos-all-white", RUN, setup=photos(lambda image: image.point(lambda value: 255))),
    either("photos-inverted", RUN, setup=photos(ImageOps.invert)),
    refused("photos-transposed", RUN, "000.jpg", setup=photos(
        lambda image: image.transpose(Image.Transpose.ROTATE_90))),
    either("photos-halved", RUN, setup=photos(lambda image: image.resize((48, 32)))),
    either("photos-doubled", RUN, setup=photos(lambda image: image.resize((192, 128)))),
    *(either(f"photo-bit-at-{place}", RUN, setup=flipped(PHOTO, place / 100))
      for place in (1, 5, 15, 50, 90)),
    refused("held-out-photo-damaged", RUN, "008.jpg", setup=truncated("sy/images/008.jpg", 500)),
    refused("eval-photo-changed-size", "clsplat eval run", "008.jpg", needs=("sy", "run"),
            setup=photo(size=(50, 50), name="sy/images/008.jpg"),
            writes=("run/renders", "run/metrics.jsonl")),
    refused("eval-photo-damaged", "clsplat eval run", "008.jpg", needs=("sy", "run"),
            setup=truncated("sy/images/008.jpg", 700), writes=("run/renders", "run/metrics.jsonl")),
    refused("eval-photo-missing", "clsplat eval run", "008.jpg", needs=("sy", "run"),
            setup="rm sy/images/008.jpg", writes=("run/renders", "run/metrics.jsonl")),
    works("eval-training-photo-missing", "clsplat render run -o out --views test", needs=("sy",
          "run"), setup="cp sy/images/001.jpg sy/images/spare.jpg"),
    either("eval-photos-replaced", "clsplat eval run --no-images", needs=("sy", "run"),
           setup=photos(ImageOps.invert), writes=("run/metrics.jsonl",)),
    either("resume-photo-replaced", "clsplat train sy -o half --resume -q",
           setup=photo(), needs=("sy", "half"), writes=("half",)),
    refused("resume-photo-removed", "clsplat train sy -o half --resume -q", NAME,
            setup=f"rm {PHOTO}", needs=("sy", "half"), writes=()),
    refused("resume-photo-damaged", "clsplat train sy -o half --resume -q", NAME,
            setup=truncated(PHOTO, 600), needs=("sy", "half"), writes=()),
    refused("resume-view-added", "clsplat synth -o sy --blocks 1x1 --views 13 --size 96x64 "
            "--overwrite && clsplat train sy -o half --resume -q", "scene", needs=("sy", "half"),
            writes=("sy",)),
    refused("eval-other-scene", "clsplat synth -o sy --blocks 1x1 --views 9 --size 64x64 --seed 4 "
            "--overwrite && clsplat eval run --no-images", "scene", needs=("sy", "run"),
            writes=("sy",)),
    refused("block-photo-missing", "clsplat block parted/blocks/000 -q", "003.jpg",
            setup=f"rm {PHOTO}", needs=("sy", "parted"), writes=("parted/blocks/000/run",)),
    refused("merge-photo-missing", "clsplat merge city", "008.jpg",
            setup="rm sy/images/008.jpg", needs=("sy", "city"), writes=("city",)),
    works("eval-touched-photos", "clsplat eval run --no-images", evaluated, needs=("sy", "run"),
          setup="touch -d 1970-01-01 sy/images/*; touch -d 2100-01-01 run/*",
          writes=("run/metrics.jsonl",)),
]
