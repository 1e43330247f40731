"""Tasks of other packages on this package's engine, so that engines are compared on the same work."""
