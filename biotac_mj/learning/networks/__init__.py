"""Networks: VAEs of skin and electrodes, PointNet++, heads on features of the skin."""
