"""Files that users name: found, read within limits, validated, replaced safely."""
