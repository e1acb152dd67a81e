"""The same protocols from the other side: simulated instruments over one World."""
