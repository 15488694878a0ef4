"""The plant: MuJoCo behind the Plant protocol, and the scene it holds."""
