"""Runs that are damaged, half written or of other versions."""

from tests.adversarial.case import either, refused, works
from tests.adversarial.checks import evaluated, same_model
from tests.adversarial.damage import edited, flipped, truncated, without, written

GO_ON = "clsplat train sy -o half --resume -q"
EVAL = "clsplat eval run --no-images"
HALF = {"needs": ("sy", "half"), "writes": ("half",)}
RUN = {"needs": ("sy", "run"), "writes": ("run/metrics.jsonl",)}
OPTIONS = "half/options.json"

CASES = [
    *(refused(f"checkpoint-bit-at-{place}", GO_ON, "checkpoint", **HALF,
              setup=flipped("half/checkpoint.npz", place / 1000, 5))
      for place in (10, 333, 500, 900)),
    *(refused(f"checkpoint-cut-{size}", GO_ON, "checkpoint", **HALF,
              setup=truncated("half/checkpoint.npz", size)) for size in (0, 100, 400_000, -1)),
    refused("checkpoint-is-folder", GO_ON, "checkpoint",
            setup="rm half/checkpoint.npz; mkdir half/checkpoint.npz", **HALF),
    refused("checkpoint-is-photo", GO_ON, "checkpoint",
            setup="cp sy/images/000.jpg half/checkpoint.npz", **HALF),
    refused("checkpoint-is-npy", GO_ON, "checkpoint", setup="python -c \"import numpy; "
            "numpy.save(open('half/checkpoint.npz', 'wb'), numpy.zeros(9))\"", **HALF),
    refused("checkpoint-of-nothing", GO_ON, "checkpoint", setup="python -c \"import numpy; "
            "numpy.savez('half/checkpoint.npz')\"", **HALF),
    refused("checkpoint-pickled", GO_ON, "checkpoint", setup="python -c \"import numpy; numpy.savez"
            "('half/checkpoint.npz', positions=numpy.array([{}], object))\"", **HALF),
    works("checkpoint-missing", GO_ON, same_model("half"), setup="rm half/checkpoint.npz", **HALF),
    works("metrics-missing", GO_ON, same_model("half"), setup="rm half/metrics.jsonl", **HALF),
    works("metrics-cut-in-line", GO_ON, same_model("half"),
          setup=truncated("half/metrics.jsonl", -30), **HALF),
    works("metrics-empty", GO_ON, same_model("half"), setup=truncated("half/metrics.jsonl", 0),
          **HALF),
    either("metrics-damaged", GO_ON, setup=written("half/metrics.jsonl", b"\xff\xfe{}\n{\n"),
           needs=("sy", "half"), writes=("half/checkpoint.npz", "half/point_cloud.ply",
                                         "half/report.html", "half/options.json")),
    either("metrics-of-other-kinds", GO_ON, setup=written("half/metrics.jsonl", '{"event": 3}\n'
           '{"event": "eval", "iteration": "x"}\n[]\n{}\nnull\n'), **HALF),
    either("metrics-iteration-text", GO_ON, setup=written(
        "half/metrics.jsonl", '{"event": "step", "iteration": "6"}\n'), **HALF),
    works("both-missing", GO_ON, same_model("half"),
          setup="rm half/metrics.jsonl half/checkpoint.npz", **HALF),
    refused("options-missing", GO_ON, "options.json", setup=f"rm {OPTIONS}", **HALF),
    refused("options-empty", GO_ON, "options.json", setup=truncated(OPTIONS, 0), **HALF),
    refused("options-cut", GO_ON, "options.json", setup=truncated(OPTIONS, 300), **HALF),
    *(refused(f"options-{name}", GO_ON, "options.json", setup=written(OPTIONS, text), **HALF)
      for name, text in (("list", "[]"), ("number", "3"), ("null", "null"),
                         ("nan", '{"seed": NaN}'), ("deep", "[" * 5000), ("bytes", b"\xff\xfe"))),
    *(refused(f"options-{key}-{str(value)[:6]}", GO_ON, f"options.json|another scene|{key}",
              setup=edited(OPTIONS, **{key: value}), **HALF)
      for key, value in (("iterations", "12"), ("iterations", -1), ("iterations", None),
                         ("levels", 3), ("levels", [0]), ("background", [0]), ("schedule", "nope"),
                         ("seed", 1.5), ("fingerprint", 7), ("fingerprint", "0"), ("init", 4),
                         ("eval_at", "x"), ("ssim_weight", []))),
    either("options-other-seed", GO_ON, setup=edited(OPTIONS, seed=7), **HALF),
    either("options-key-unknown", GO_ON, setup=edited(OPTIONS, new_in_version_9=[1]), **HALF),
    either("options-other-version", GO_ON, setup=edited(OPTIONS, version="99.0"), **HALF),
    *(either(f"options-without-{key}", GO_ON, setup=without(OPTIONS, key), **HALF)
      for key in ("decisions", "version", "seed", "scene", "fingerprint", "extent", "offset")),
    *(either(f"options-{key}-of-kind-{kind}", GO_ON, setup=edited(OPTIONS, **{key: value}), **HALF)
      for key in ("decisions", "extent", "offset", "scene", "opencl_device", "version")
      for kind, value in (("null", None), ("list", [1]), ("number", -3))),
    *(refused(f"eval-options-{name}", EVAL, "options.json|run", setup=written(
        "run/options.json", text), needs=("sy", "run"), writes=()) for name, text in (
            ("empty", ""), ("of-nothing", "{}"), ("list", "[]"), ("cut", '{"scene": "'))),
    *(either(f"eval-options-{key}-{kind}", EVAL, setup=edited("run/options.json", **{key: value}),
             **RUN) for key, kind, value in (
        ("downscale", "zero", 0), ("downscale", "text", "x"), ("test_every", "large", 10**9),
        ("max_resolution", "negative", -5), ("scene", "folder", "/"), ("scene", "empty", ""),
        ("scene", "null-byte", "a\0b"), ("near", "null", None), ("background", "text", "x"),
        ("antialiased", "number", 3), ("offset", "text", "x"), ("fingerprint", "null", None))),
    works("eval-metrics-missing", EVAL, evaluated, setup="rm run/metrics.jsonl", **RUN),
    either("eval-metrics-damaged", EVAL, setup=written("run/metrics.jsonl", b"\xff\n{\n"),
           needs=("sy", "run"), writes=("run/metrics.jsonl",)),
    works("eval-model-only", EVAL, evaluated, setup="rm run/checkpoint.npz run/report.html", **RUN),
    *(either(f"compare-{name}", "clsplat compare run -o out", setup=setup, needs=("run",))
      for name, setup in (
        ("metrics-missing", "rm run/metrics.jsonl"),
        ("metrics-empty", truncated("run/metrics.jsonl", 0)),
        ("metrics-cut", truncated("run/metrics.jsonl", -100)),
        ("metrics-one-line", "head -n 1 run/metrics.jsonl > m; mv m run/metrics.jsonl"),
        ("metrics-nulls", written("run/metrics.jsonl", '{"event": "eval", "psnr": null}\n')),
        ("metrics-words", written("run/metrics.jsonl", '{"event": "eval", "iteration": 3, '
         '"train_seconds": "x", "psnr": "y", "psnr_cc": [], "gaussians": {}}\n')),
        ("metrics-infinite", written("run/metrics.jsonl", '{"event": "eval", "iteration": 3, '
         '"train_seconds": 1e400, "psnr": 1, "psnr_cc": 1, "ssim": 1, "gaussians": 9}\n')),
        ("options-script", edited("run/options.json", scene="<script>alert(1)</script>",
                                  opencl_device="</style><script>")),
        ("options-nan", written("run/options.json", '{"seed": NaN}')))),
    works("report-missing", GO_ON, same_model("half"), setup="rm -f half/report.html", **HALF),
    works("finished-model-missing", "clsplat train sy -o run --resume -q", same_model("run"),
          needs=("sy", "run"), setup="rm run/point_cloud.ply", writes=("run",)),
    works("finished-model-cut", "clsplat train sy -o run --resume -q", same_model("run"),
          needs=("sy", "run"), setup=truncated("run/point_cloud.ply", 999), writes=("run",)),
]
