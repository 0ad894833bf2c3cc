"""Units of a rig's constants, for tables, files and the analysis of dimensions."""

UNITS = {"motor.inertia": "kg m^2", "motor.damping": "N m s/rad", "motor.gain": "N m/count",
         "drive.stiffness": "N m/rad", "drive.damping": "N m s/rad", "base.inertia": "kg m^2",
         "clamp.stiffness": "N m/rad", "clamp.damping": "N m s/rad", "beam.mass_per_length": "kg/m",
         "beam.length": "m", "beam.flexural_rigidity": "N m^2", "beam.damping": "s",
         "beam.rigidity_1": "1", "beam.rigidity_2": "1", "beam.rigidity_3": "1",
         "tip.mass": "kg", "tip.inertia": "kg m^2", "accelerometer.gain": "counts s^2/m"}
