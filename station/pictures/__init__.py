"""Pictures that show a cause: what is missing once it is taken out, and its law drawn through that."""
