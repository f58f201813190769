"""Use of JAX and of the machine: settings, threads, devices, compiled programs."""
