"""The simulated bench as a program: its instruments, control socket and bench file."""
