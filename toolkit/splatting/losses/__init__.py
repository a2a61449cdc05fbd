"""What the optimisation of a map minimises, and its gradients."""
