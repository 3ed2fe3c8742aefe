"""Linear algebra between light and light: encoding, basis, transfer matrix and the choice of its ridge.

Enters: JAX arrays, lightings first. Leaves: values with a status; trouble is a field, never a print and never a NaN.
Sums, Gram matrices and factorisations are float64 inside `jax.enable_x64`, whatever the caller's flags. Files and scenes
never enter.
"""
