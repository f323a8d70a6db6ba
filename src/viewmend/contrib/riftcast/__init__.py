"""The RIFTCast wire protocol."""
