"""Files: locks, work folders, remote files, and files of tensors."""
