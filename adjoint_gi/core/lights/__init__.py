"""What emits: sampled for gathering, or as particles for shooting."""
