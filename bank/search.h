/* The search of a compressed bank for one frame: what bank/_search.c hands to Python, without Python in it. */

#ifndef SHEARLOOP_SEARCH_H
#define SHEARLOOP_SEARCH_H

#include <stddef.h>
#include <stdint.h>

enum {
    CHANNELS = 896,
    MOST_LEVELS = 8,
    MOST_RANK = 128,
    LANES = 8,
    /* Real transforms of this length hold all lags; they are computed as complex ones of half of it. */
    LENGTH = 2048,
    HALF = LENGTH / 2,
    /* Of the turns of its five passes: 256 + 64 + 16 + 4 + 1. */
    TURNS = 341,
    MOST_KNOWN = 64
};

/* BLAS's sgemm. */
typedef void Multiply(const char *transpose_a, const char *transpose_b, const int *m, const int *n, const int *k,
                      const float *alpha, const float *a, const int *lda, const float *b, const int *ldb,
                      const float *beta, float *c, const int *ldc);

/* Groups, or in the last level cells, in blocks of eight; a block's parts all belong to one group of the level before. */
typedef struct {
    const float *blocks;   /* (n, width + 2, 8): what bounds them, side by side */
    const int32_t *parts;  /* (n, 8): their numbers; where there is none, nothing reaches its bound */
    const int32_t *starts; /* (groups of the level before + 1,): where the blocks of each begin; all are of one before the first */
    ptrdiff_t n, n_before;
} Level;

typedef struct {
    float bound;
    float estimate;
    int32_t cell;
    int32_t lag;
    double score; /* below 0 until it is known */
} Candidate;

typedef struct {
    int32_t cell;
    double score;
} Found;

/* e to the power of i times an angle: of the passes of a transform, three turns (cosines, sines) each, and of its halves. */
typedef struct {
    float of_pass[6][TURNS];
    float of_half[2][HALF / 2 + 1];
    uint16_t reversed[HALF]; /* where each number lies after the passes */
} Turns;

/* A compressed bank (bank/compression.py), and room to work in; bank/compiled_search.py says what the arrays are. */
typedef struct {
    ptrdiff_t coarse_rank, fine_rank, n_cells;
    ptrdiff_t width;                /* the coarse rank, filled up to eights with zeros */
    const float *basis;             /* (fine_rank, 896) */
    const float *fine;              /* (n_cells, fine_rank + 2) */
    const float *signals;           /* (any, 896) */
    const int64_t *places;          /* (n_cells,): the row of each cell in `signals` */
    const double *norms;            /* (n_cells,) */
    const int32_t *k_of, *sigma_of; /* (n_cells,): the place of each cell in the grid */
    const double *overlaps;         /* (1792,): of the lags from -896 up */
    const float *spectra;           /* (width / 8, HALF + 1, 2, 8): conjugate transforms of the basis, over LENGTH */
    const float *roots;             /* (8 levels[0].n, width + 2): the first level once more, one row after the other */
    Level levels[MOST_LEVELS + 1];
    int n_levels; /* of groups; the cells come after them */
    Multiply *multiply;
    double rounding, square_rounding, tie, tie_rounding;
    long radius;
    Turns turns;
    Candidate *candidates; /* (most_candidates,), at least one for each cell */
    ptrdiff_t most_candidates;
    float *root_estimates, *root_bounds; /* (8 levels[0].n,) */
    int32_t *lists[2];                   /* (most_listed,): groups of a level that are looked into */
    ptrdiff_t most_listed;
    float *bounds;  /* (lags that are looked at, 8 levels[0].n) */
    float *columns; /* (2 * CHANNELS, width + 2): the frame at each lag that is looked at */
    float *points;  /* (HALF, 2, 8): eight transforms side by side */
} Bank;

/* A frame that is searched for, and what has been found of it. */
typedef struct {
    const Bank *bank;
    /* With as many zeros before and after it: at lag l the frame begins at CHANNELS + l. */
    double padded[3 * CHANNELS];
    float single[3 * CHANNELS];
    double energies[2 * CHANNELS]; /* of the part that overlaps, at the lags from -896 up */
    float column[MOST_RANK + 2];   /* at lag 0 */
    /* Of the search that is under way. */
    double reached;       /* a score that some cell has */
    float least;          /* what is bounded below this cannot have it */
    int32_t apart_from;   /* only cells outside the peak of this one count; -1: all */
    long scores_left;     /* so many may still be computed */
    long looks_left;      /* so many blocks may still be bounded */
    ptrdiff_t n_candidates;
    /* At all lags. */
    int first, n_lags;              /* the first lag that is looked at, and how many are */
    float highest[2 * CHANNELS];    /* the highest bound at each of them */
    Found best;                     /* the best that is known */
    Found known[MOST_KNOWN];
    int n_known;
    double collected; /* what can reach this has been collected */
} Hunt;

typedef enum { NONE, FOUND, UNDECIDED } Outcome;

/* Take the magnitudes of a (896,) difference, scaled to the norm 1; 0 where they have none. */
int take_frame(Hunt *hunt, const Bank *bank, const double *difference);

/* Find the cell of the highest score at lag 0, the first of those that tie, outside the peak of `apart_from` or, if that
   is -1, anywhere. UNDECIDED: it hangs on rounding which cells tie, or too many would have to be scored. */
Outcome find_at_lag_0(Hunt *hunt, int32_t apart_from, long most_scores, Found *found);

/* Find the best cell at all lags and, if `other` is not NULL, the best one outside its peak. UNDECIDED also where there
   is too much to look at. */
Outcome find_at_all_lags(Hunt *hunt, long most_scores, Found *best, Found *other);

/* bank/candidates.c: from a number on, where they take one. */

/* Some cell has this score: what is bounded below it counts no more. */
void reaches(Hunt *hunt, double score);

static inline int may_reach(const Hunt *hunt, float bound)
{
    return bound >= hunt->least;
}

/* Append those of eight parts whose bounds may reach what is known to a list of n, and return how many there are then:
   without a branch, which nobody could foretell. */
static inline ptrdiff_t list_parts(const Hunt *hunt, const float *bounds, const int32_t *parts, int32_t *list, ptrdiff_t n)
{
    for (int lane = 0; lane < LANES; lane++) {
        list[n] = parts[lane];
        n += may_reach(hunt, bounds[lane]);
    }
    return n;
}

int in_peak_of(const Bank *bank, int32_t cell, int32_t other);

double score_of(const Hunt *hunt, int32_t cell, int32_t lag);

/* Compute a frame's numbers from one on up to before `rank`, at a lag. */
void project(const Hunt *hunt, int32_t lag, ptrdiff_t from, ptrdiff_t rank, float *column);

/* Estimate and bound the first level's groups. */
void bound_roots(const Hunt *hunt, const float *column);

/* Add the cells that may reach what is known to the candidates: those in n groups of a level, which are in
   bank->lists[level % 2]. */
void look_into(Hunt *hunt, const float *column, int32_t lag, int level, ptrdiff_t n);

/* Leave out the candidates that are bounded below what is known now. */
void keep_what_may_reach(Hunt *hunt, ptrdiff_t from);

/* The same, and where there are many still, all at one lag, bound them anew: the frame's other numbers there cost as much
   as some scores. */
void bound_anew(Hunt *hunt, const float *column, int32_t lag, ptrdiff_t from);

/* Of the candidates that are not scored yet, outside the peak of `apart_from` and bounded from `least` up, the one of the
   highest estimate; NULL where there is none. */
Candidate *likeliest(const Hunt *hunt, ptrdiff_t from, int32_t apart_from, float least);

/* The highest bound first: what is scored then leaves out others. */
void sort_candidates(Hunt *hunt);

/* bank/lags.c */

void fill_turns(Turns *turns);

/* Look at the lags at which any cell may have a score: compute the frame's columns there, and bound the first level's
   groups. 0 where there is none. */
int take_lags(Hunt *hunt, double score);

/* Complete a column of bank/compression.py at a lag: after the frame's first `rank` numbers come the norm of all of these
   but the first, and what is left of the frame. */
void complete_column(const Hunt *hunt, int32_t lag, ptrdiff_t rank, float *column);

#endif
