"""How good matches, areas, poses and reconstructions are: metrics, and readers of ground truth."""
