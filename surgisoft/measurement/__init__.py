"""What a lab records: recordings, importers, protocols and the virtual rig."""
