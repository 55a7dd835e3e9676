"""Files and folders that may not be read or written; root without its privileges stands for a user
to whom they apply."""

import os
import shutil

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import evaluated, no_model, pictures, same_model

RUN = "unprivileged clsplat train sy -n 12 --checkpoint-every 4 -q -o out"
GO_ON = "unprivileged clsplat train sy -o half --resume -q"
MOUNT = "mount --bind -o ro {0} {0} && mount -o remount,ro,bind {0}"

CASES = [
    refused("scene-unreadable", RUN, "sy", setup="chmod 0 sy"),
    refused("photos-unreadable", RUN, "images", setup="chmod 0 sy/images"),
    refused("photo-unreadable", RUN, "003.jpg", setup="chmod 0 sy/images/003.jpg", quick=True),
    refused("model-unreadable", RUN, "sparse", setup="chmod 0 sy/sparse"),
    refused("points-unreadable", RUN, "points3D", setup="chmod 0 sy/sparse/0/points3D.bin"),
    refused("cameras-unreadable", RUN, "cameras", setup="chmod 0 sy/sparse/0/cameras.bin"),
    refused("images-bin-unreadable", RUN, "images", setup="chmod 0 sy/sparse/0/images.bin"),
    works("scene-read-only", RUN, same_model(), setup="chmod -R a-w sy"),
    refused("output-in-read-only", RUN.replace("-o out", "-o d/out"), "d/out",
            setup="mkdir -m 555 d"),
    refused("output-read-only", RUN, "out", setup="mkdir -m 555 out"),
    refused("output-unreadable", RUN, "out", setup="mkdir -m 0 out"),
    refused("config-unreadable", f"{RUN} --config c.toml", "c.toml", setup="install -m 0 /dev/null "
            "c.toml"),
    refused("init-unreadable", f"{RUN} --init m.ply", "m.ply", needs=("sy", "run"),
            setup="install -m 0 run/point_cloud.ply m.ply"),
    refused("resume-read-only", GO_ON, "half", setup="chmod 555 half", needs=("sy", "half"),
            writes=()),
    refused("resume-checkpoint-unreadable", GO_ON, "checkpoint", setup="chmod 0 "
            "half/checkpoint.npz", needs=("sy", "half"), writes=()),
    refused("resume-metrics-read-only", GO_ON, "metrics", setup="chmod 444 half/metrics.jsonl; "
            "chmod 555 half", needs=("sy", "half"), writes=()),
    refused("resume-options-unreadable", GO_ON, "options", setup="chmod 0 half/options.json",
            needs=("sy", "half"), writes=()),
    works("eval-read-only-no-images", "unprivileged clsplat eval run --no-images", evaluated,
          setup="chmod -R a-w run", needs=("sy", "run"), writes=()),
    refused("eval-read-only", "unprivileged clsplat eval run", "run", setup="chmod -R a-w run",
            needs=("sy", "run"), writes=()),
    refused("eval-model-unreadable", "unprivileged clsplat eval run", "point_cloud.ply",
            setup="chmod 0 run/point_cloud.ply", needs=("sy", "run"), writes=()),
    refused("eval-pictures-read-only", "unprivileged clsplat eval run", "renders",
            setup="mkdir -p run/renders/test; chmod -R 555 run/renders", needs=("sy", "run"),
            writes=("run/metrics.jsonl",)),
    refused("eval-picture-read-only-folder", "unprivileged clsplat eval run", "renders",
            setup="mkdir -p run/renders; chmod 555 run/renders", needs=("sy", "run"),
            writes=("run/metrics.jsonl",)),
    works("render-from-read-only", "unprivileged clsplat render run -o out --views test",
          pictures(2), setup="chmod -R a-w run sy", needs=("sy", "run")),
    refused("render-into-read-only", "unprivileged clsplat render run -o out", "out",
            setup="mkdir -m 555 out", needs=("sy", "run")),
    refused("render-over-read-only-folder", "unprivileged clsplat render run -o out", "out",
            setup="mkdir out; mkdir -m 555 out/d; chmod 555 out", needs=("sy", "run")),
    refused("export-into-read-only", "unprivileged clsplat export run -o d/out.ply", "d/out.ply",
            setup="mkdir -m 555 d", needs=("sy", "run")),
    works("export-over-read-only-file",
          "unprivileged clsplat export run -o out.ply --overwrite",
          setup="install -m 444 /dev/null out.ply", needs=("sy", "run"), writes=("out.ply",)),
    works("export-from-read-only", "unprivileged clsplat export run -o out.ply",
          setup="chmod -R a-w run", needs=("sy", "run"), writes=("out.ply",)),
    refused("compare-into-read-only", "unprivileged clsplat compare run -o out", "out",
            setup="mkdir -m 555 out", needs=("run",)),
    refused("compare-beside-read-only", "unprivileged clsplat compare run", "run",
            setup="chmod 555 run .", needs=("run",), writes=()),
    works("compare-of-read-only", "unprivileged clsplat compare run -o out",
          setup="chmod -R a-w run", needs=("run",)),
    refused("overwrite-read-only", "unprivileged clsplat train sy -n 4 -q -o run --overwrite",
            "run", setup="chmod 555 run", needs=("sy", "run"), writes=()),
    either("overwrite-renders-read-only", "unprivileged clsplat train sy -n 4 -q -o run "
           "--overwrite", setup="mkdir -p run/renders/test; touch run/renders/test/000.jpg.png; "
           "chmod -R 555 run/renders", needs=("sy", "run"), writes=("run",)),
    refused("city-into-read-only", "unprivileged clsplat city sy -n 8 --grid 2x1 -q -o d/out",
            "d/out", setup="mkdir -m 555 d"),
    refused("city-beside-read-only", "unprivileged clsplat city d/sy -n 8 --grid 2x1 -q",
            "sy.city", setup="mkdir d; mv sy d; chmod 555 d"),
    refused("merge-read-only", "unprivileged clsplat merge city", "city",
            setup="chmod 555 city", needs=("sy", "city"), writes=()),
    refused("block-read-only", "unprivileged clsplat block parted/blocks/000 -q", "000",
            setup="chmod -R a-w parted/blocks/000", needs=("sy", "parted"), writes=()),
    refused("block-unreadable-region", "unprivileged clsplat block parted/blocks/000 -q", "region",
            setup="chmod 0 parted/blocks/000/region.json", needs=("sy", "parted"),
            writes=("parted/blocks/000/run",)),
    refused("merge-block-unreadable", "unprivileged clsplat merge city", "000",
            setup="chmod 0 city/blocks/000/run/point_cloud.ply", needs=("sy", "city"),
            writes=("city/metrics.jsonl",)),
    refused("partition-read-only", "unprivileged clsplat partition parted --grid 2x1", "parted",
            setup="rm -r parted/partition* parted/blocks; chmod 555 parted",
            needs=("sy", "parted"), writes=()),
    refused("synth-into-read-only", "unprivileged clsplat synth -o d/out", "d", needs=(),
            setup="mkdir -m 555 d"),
    refused("lock-unwritable", GO_ON, "half", setup="touch half/.lock; chmod 0 half/.lock; "
            "chmod 555 half", needs=("sy", "half"), writes=()),
    either("lock-is-folder", GO_ON, setup="rm -f half/.lock; mkdir half/.lock",
           needs=("sy", "half"), writes=("half",)),
    either("lock-is-link", GO_ON, setup="echo mine > mine; ln -sf ../mine half/.lock",
           needs=("sy", "half"), writes=("half",)),
]
if hasattr(os, "geteuid") and os.geteuid() == 0 and shutil.which("mount"):
    CASES += [
        refused("bind-mount-eval", f"{MOUNT.format('run')} && clsplat eval run", "run",
                needs=("sy", "run"), writes=()),
        works("bind-mount-eval-no-images", f"{MOUNT.format('run')} && clsplat eval run "
              "--no-images", evaluated, needs=("sy", "run"), writes=()),
        works("bind-mount-scene", f"{MOUNT.format('sy')} && clsplat train sy -n 12 "
              "--checkpoint-every 4 -q -o out", same_model()),
        refused("bind-mount-output", f"mkdir out && {MOUNT.format('out')} && clsplat train sy -n 4 "
                "-q -o out", "out", no_model()),
        refused("bind-mount-resume", f"{MOUNT.format('half')} && clsplat train sy -o half "
                "--resume -q", "half", needs=("sy", "half"), writes=()),
        refused("bind-mount-merge", f"{MOUNT.format('city')} && clsplat merge city", "city",
                needs=("sy", "city"), writes=()),
        refused("bind-mount-city", f"{MOUNT.format('city')} && clsplat city sy -n 8 --grid 2x1 -q "
                "-o city", "city", needs=("sy", "city"), writes=()),
        refused("bind-mount-synth", f"{MOUNT.format('sy')} && clsplat synth -o sy --overwrite",
                "sy"),
        works("bind-mount-render", f"{MOUNT.format('run')} && clsplat render run -o out "
              "--views test", pictures(2), needs=("sy", "run")),
        works("bind-mount-plan", f"{MOUNT.format('sy')} && clsplat plan sy -n 4"),
    ]
