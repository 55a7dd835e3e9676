"""What leaves clsplat: finished models made smaller for viewers and other programs."""
