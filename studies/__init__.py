"""What judges methods and papers: charts, the reproduction of the papers, reference models, synthetic recordings."""
