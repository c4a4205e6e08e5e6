"""The methods that the paper compares with (Sec. 4.2, 4.3): regions and scene in, instance ids out."""
