"""What the paper does about faults that nobody has diagnosed: correction of abnormal values,
fault-aware training."""
