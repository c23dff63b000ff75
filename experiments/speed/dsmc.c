/* Direct simulation of a homogeneous gas of spheres, on one core: the reference of
 * benchmark_particles.py --only references.
 *
 *     cc -O3 -march=native dsmc.c -lm -o dsmc
 *     ./dsmc N COLLISIONS_PER_SPHERE RESTITUTION
 *
 * prints "COLLISIONS SECONDS TEMPERATURE". Pairs are drawn at random, and collide with a probability
 * in proportion to their relative speed. RESTITUTION < 0: viscoelastic spheres whose dissipation
 * parameter at the speed 1 is its opposite (Pade approximant of Mueller & Poeschel, Phys. Rev. E 84,
 * 021302 (2011)).
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static uint64_t state[2] = {0x9E3779B97F4A7C15ULL, 0xBF58476D1CE4E5B9ULL};

/* xorshift128+ */
static uint64_t random_bits(void) {
    uint64_t a = state[0], b = state[1];
    state[0] = b;
    a ^= a << 23;
    state[1] = a ^ b ^ (a >> 18) ^ (b >> 5);
    return a + b;
}

static double uniform(void) { return (random_bits() >> 11) * 0x1p-53; }

static double gaussian(void) {
    return sqrt(-2 * log(1 - uniform())) * cos(2 * M_PI * uniform());
}

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static double restitution(double eps, double speed) {
    if (eps >= 0) return eps;
    double b = sqrt(-eps * pow(speed, 0.2));
    return (1 + 0.501086 * b) /
           (1 + b * (0.501086 + b * (1.15345 + b * (0.577977 + b * 0.532178))));
}

int main(int count, char **arguments) {
    if (count != 4) {
        fprintf(stderr, "usage: dsmc N COLLISIONS_PER_SPHERE EPS\n");
        return 2;
    }
    const uint64_t n = strtoull(arguments[1], NULL, 10);
    const long wanted = (long)(atof(arguments[2]) * n / 2);
    const double eps = atof(arguments[3]);
    double(*v)[3] = malloc(n * sizeof *v);
    double energy = 0;
    for (uint64_t i = 0; i < n; i++)
        for (int k = 0; k < 3; k++) {
            v[i][k] = gaussian();
            energy += v[i][k] * v[i][k];
        }
    long collisions = 0;
    double begin = seconds();
    while (collisions < wanted) {
        double fastest = 5 * sqrt(2 * energy / (3 * n));
        for (int candidate = 0; candidate < 65536; candidate++) {
            uint64_t bits = random_bits();
            uint64_t i = ((bits >> 32) * n) >> 32, j = ((bits & 0xffffffff) * n) >> 32;
            if (i == j) continue;
            double w[3], square = 0, bound = uniform() * fastest;
            for (int k = 0; k < 3; k++) {
                w[k] = v[i][k] - v[j][k];
                square += w[k] * w[k];
            }
            if (bound * bound > square) continue;
            /* The normal of an impact of hard spheres bisects w and an isotropic direction. */
            double speed = sqrt(square), up = 2 * uniform() - 1, angle = 2 * M_PI * uniform();
            double across = sqrt(1 - up * up);
            double normal[3] = {
                w[0] - speed * across * cos(angle),
                w[1] - speed * across * sin(angle),
                w[2] - speed * up,
            };
            double length = 0, along = 0;
            for (int k = 0; k < 3; k++) {
                length += normal[k] * normal[k];
                along += w[k] * normal[k];
            }
            if (length <= 0) continue;
            double e = restitution(eps, along / sqrt(length));
            for (int k = 0; k < 3; k++) {
                double change = (1 + e) / 2 * along / length * normal[k];
                v[i][k] -= change;
                v[j][k] += change;
            }
            energy -= (1 - e * e) / 2 * along * along / length;
            collisions++;
        }
    }
    printf("%ld %.6f %.6f\n", collisions, seconds() - begin, energy / (3 * n));
    free(v);
    return 0;
}
