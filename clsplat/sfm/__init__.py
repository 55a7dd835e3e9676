"""From a folder of photos to a scene: structure from motion (SfM) by COLMAP's library."""
