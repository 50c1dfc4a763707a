"""The paper's simulation study and the measurements: what `python -m jaxbridge` runs."""
