"""What a machine will do: its accuracy, cycles, resources and energy, and sweeps over possible machines."""
