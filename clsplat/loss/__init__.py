"""What training minimises: the terms of the loss (`terms`), and the exposures of the photos."""
