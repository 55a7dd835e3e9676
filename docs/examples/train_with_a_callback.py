"""Train until the loss is low enough: python train_with_a_callback.py SCENE RUN"""

import sys

import clsplat


def stop_when_good(record):
    if record["event"] == "step" and record["iteration"] % 50 == 0:
        print(f"step {record['iteration']}: loss {record['loss']:.3f}, "
              f"{record['gaussians']:,} gaussians")
    if record["event"] == "step" and record["loss"] < 0.12:
        raise clsplat.StopTraining


run = clsplat.train(clsplat.Scene.read(sys.argv[1]), sys.argv[2], iterations=300, downscale=4,
                    schedule="constant", callbacks=[stop_when_good])
print(run, run.model, f"{run.metrics[-1]['train_seconds']} s of training")
