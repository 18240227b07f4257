"""What a log tells: all findings, how severe each is, and checks of its readings."""
