"""The second engine: PyBullet, which shares no code with MuJoCo. Needs the extra `bench`."""
