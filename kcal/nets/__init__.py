"""The paper's networks, one file each with its fit: residual (Eq. 11), inverse (Eq. 12), pure network lens (4.3.1)."""
