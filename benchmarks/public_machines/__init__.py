"""Cases of B3: name -> function that runs it."""

from public_machines.axis import run as axis
from public_machines.oscillator import run as oscillator
from public_machines.turning_arm import flexible, rigid

CASES = {"silverbox": oscillator, "emps": axis, "rigid arm": rigid, "flexible arm": flexible}
