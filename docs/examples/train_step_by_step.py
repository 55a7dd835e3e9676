"""Train until the loss is low enough: python train_step_by_step.py SCENE RUN"""

import sys

import numpy as np

import clsplat

options = clsplat.TrainOptions(iterations=300, downscale=4, schedule="constant")
with clsplat.Trainer(sys.argv[1], options, output=sys.argv[2], overwrite=True) as trainer:
    for step in trainer:  # reading the loss waits for the device
        if step.iteration % 50 == 0:
            print(f"step {step.iteration}: loss {step.loss:.3f}, {step.gaussians:,} gaussians")
            if step.loss < 0.12:
                break
        if step.iteration == 100:  # the model may be changed between steps
            trainer.update(opacity_logits=np.minimum(step.model.opacity_logits, 3.0))
    trainer.save()
print(trainer.run, trainer.run.model)
