"""The quality of a model: metrics against held-out photos, plain and after a colour fit.

Photos drift in brightness and white balance, and a held-out view has no learned exposure. So every
score exists twice: plain, and after the render's colours were fitted to the photo (`_cc`).
"""
