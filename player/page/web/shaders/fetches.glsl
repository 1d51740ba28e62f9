// Chooses where along a ray features are fetched: at the samples, or at the centroids of k bins of equal mass. The twin of
// player/march/fetches.py.
//
// A ray is marched once, and up to KEPT of its samples are kept; a ray that has more is marched again.

uniform int uFetches; // k; 0 fetches at every sample

vec2 kept[KEPT]; // s and weight
float total = 0.0, moment = 0.0;
int nWeights = 0;

// March the ray and keep its samples. Jumps and samples are steps of a single loop, so that rays that the GPU draws as a
// group need not wait for each other.
void keepSamples(inout March march) {
  float s, weight;
  for (int guard = 0; guard < MOST_STEPS; guard++) {
    if (!stepOn(march, s, weight)) break;
    if (weight <= 0.0) continue;
    if (nWeights < KEPT) kept[nWeights] = vec2(s, weight);
    nWeights++;
    total += weight;
    moment += weight * s;
  }
}

// Find the next sample with weight, among those kept or by marching again; return false if there is none.
bool again(inout March march, inout int i, out float s, out float weight) {
  if (nWeights > KEPT) {
    for (int guard = 0; guard < MOST_STEPS; guard++) {
      if (!stepOn(march, s, weight)) return false;
      if (weight > 0.0) return true;
    }
    return false;
  }
  if (i >= nWeights) return false;
  s = kept[i].x;
  weight = kept[i].y;
  i++;
  return true;
}

#if LAYER == 0
void fetchFeatures(float opacity) {
  March march = begun();
  int i = 0;
  bool few = uFetches == 0 || nWeights <= uFetches; // then each sample is a bin
  int nBins = few ? nWeights : uFetches;
  float mass = total / float(nBins), s = 0.0, left = 0.0;
  for (int bin = 0; bin < MOST_STEPS; bin++) {
    if (bin >= nBins) break;
    float filled = 0.0, sum = 0.0, most = -1.0, heavy = 0.0;
    for (int guard = 0; guard < MOST_STEPS; guard++) {
      if (left <= 0.0 && !again(march, i, s, left)) break;
      float part = few ? left : min(left, mass - filled);
      sum += part * s;
      filled += part;
      left -= part;
      if (part > most) {
        most = part;
        heavy = s;
      }
      if (few || filled >= mass) break;
    }
    if (filled <= 0.0) break;
    float weight = few ? filled : opacity / float(uFetches);
    float place = few ? heavy : sum / filled;
    for (int attempt = 0; attempt < 2; attempt++) { // a loop, so that the code of addFeatures is compiled only once
      if (addFeatures(placeAt(place), weight) || few) break;
      place = heavy;
    }
  }
}
#endif

// Return s where half of the ray's mass is reached.
float middlePlace() {
  March march = begun();
  int i = 0;
  float s = 0.0, weight, mass = 0.0;
  for (int guard = 0; guard < MOST_STEPS; guard++) {
    if (!again(march, i, s, weight)) break;
    mass += weight;
    if (mass >= 0.5 * total) break;
  }
  return s;
}
