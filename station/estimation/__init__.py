"""Estimation: a rig's parameters from runs, by prediction errors over two horizons (its modules: ARCHITECTURE.md)."""
