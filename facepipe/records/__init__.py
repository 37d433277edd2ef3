"""What a file of another format keeps of a face beside what that format has a place for."""
