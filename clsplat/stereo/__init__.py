"""Dense points from photos with known poses, by multi-view stereo."""
