"""What training minimises. A loss returns its value and its gradient by the image together."""
