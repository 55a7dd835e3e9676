"""Predicts the memory and time of a training from a few real steps.

`clsplat.training.start.prepare` decides which parts a scene needs, as in a training, and
`clsplat.schedule.simulate` predicts the schedule.
"""
