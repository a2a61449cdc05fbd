"""Classes of indoor surfaces from depth alone, by a network that has seen synthetic rooms only."""
