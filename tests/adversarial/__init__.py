"""Hostile cases, two processes at once, full disks and interrupts: see README.md here."""
