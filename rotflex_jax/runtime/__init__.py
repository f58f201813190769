"""What the package needs of JAX and of the machine: settings, threads, devices, compiled programs."""
