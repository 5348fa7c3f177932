"""Houses and objects on disk: catalogue, downloads, checksums and licences."""
