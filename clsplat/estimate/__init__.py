"""What a training will take, before it is begun: memory by counting, time by a few real steps.

What a scene needs is decided in `clsplat.training.decisions`, which the training itself asks; how
its schedule will go is in `clsplat.schedule.simulate`.
"""
