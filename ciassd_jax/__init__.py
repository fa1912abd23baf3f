"""CIA-SSD in JAX."""
