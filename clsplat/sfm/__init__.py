"""From a folder of photos to a scene: structure from motion (SfM) by COLMAP's library.

`reconstruct.py` reads as the pipeline: photos, features, pairs, matches, mapping, scene.
Everything that is unfinished lies in the folder `.sfm` of the scene, so that a killed command
continues where it was.
"""
