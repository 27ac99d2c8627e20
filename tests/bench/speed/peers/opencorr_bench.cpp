// Measures the steps of a job of run_opencorr.py with OpenCorr: image files to files of positions.
//
// OpenCorr is in no registry. Who has its sources in $OPENCORR, nanoflann 1.5 or newer in $NANOFLANN, and Debian's libeigen3-dev,
// libfftw3-dev and libopencv-dev, builds it by
//
//   g++ -std=c++17 -O3 -march=native -fopenmp -w -I$OPENCORR/src -I$NANOFLANN/include $(pkg-config --cflags eigen3 opencv4) \
//     -I$(pkg-config --variable=prefix eigen3)/include/eigen3/Eigen -o build/opencorr_bench \
//     tests/bench/speed/peers/opencorr_bench.cpp \
//     $OPENCORR/src/oc_{calibration,cubic_bspline,deformation,dic,feature_affine,fftcc,gradient,icgn,image}.cpp \
//     $OPENCORR/src/oc_{nearest_neighbor,sift,stereovision,subset}.cpp \
//     -lopencv_core -lopencv_imgproc -lopencv_imgcodecs -lopencv_features2d -lopencv_flann -lfftw3f -lfftw3
//
// and names it to the bench: STEREORIG_BENCH_OPENCORR=$PWD/build/opencorr_bench make bench
#include <cmath>
#include <fstream>
#include <iostream>
#include <omp.h>

#include "opencorr.h"

using namespace opencorr;
using std::string;
using std::vector;

static Calibration camera(std::istream& in, int height, int width) {
    CameraIntrinsics i;
    CameraExtrinsics e;
    for (float& value : i.cam_i) value = 0.f;
    in >> i.fx >> i.fy >> i.fs >> i.cx >> i.cy >> i.k1 >> i.k2 >> i.p1 >> i.p2 >> i.k3;
    in >> e.tx >> e.ty >> e.tz >> e.rx >> e.ry >> e.rz;
    Calibration found(i, e);
    found.prepare(height, width);
    return found;
}

// affine motion of the features around each point, as a start
static void start(Image2D& from, Image2D& to, int radius, int threads, vector<POI2D>& points) {
    SIFT2D sift;
    sift.setImages(from, to);
    sift.prepare();
    sift.compute();
    FeatureAffine2D affine(radius, radius, threads);
    affine.setImages(from, to);
    affine.setKeypointPair(sift.ref_matched_kp, sift.tar_matched_kp);
    affine.prepare();
    affine.compute(points);
}

template <class Fit> static void refine(Fit& fit, Image2D& from, Image2D& to, vector<POI2D>& points) {
    fit.setImages(from, to);
    fit.prepare();
    fit.compute(points);
}

static vector<Point2D> moved(const vector<POI2D>& points, vector<char>& good) {
    vector<Point2D> out(points.size(), Point2D());
    for (size_t n = 0; n < points.size(); n++) {
        good[n] = good[n] && points[n].result.zncc > 0.f;  // its failures are negative
        out[n].x = points[n].x + points[n].deformation.u;
        out[n].y = points[n].y + points[n].deformation.v;
    }
    return out;
}

int main(int, char** arguments) {
    std::ifstream job(arguments[1]);
    int threads, radius, steps, columns, rows;
    float x0, y0, spacing;
    string out;
    job >> out >> threads >> radius >> x0 >> y0 >> spacing >> columns >> rows >> steps;
    omp_set_num_threads(threads);
    vector<string> files1(steps + 1), files2(steps + 1);
    for (int n = 0; n <= steps; n++) job >> files1[n] >> files2[n];
    Image2D one(files1[0]), two(files2[0]);
    Calibration cam1 = camera(job, one.height, one.width), cam2 = camera(job, two.height, two.width);
    Stereovision stereo(&cam1, &cam2, threads);
    stereo.prepare();

    vector<POI2D> rest;
    for (int r = 0; r < rows; r++)
        for (int c = 0; c < columns; c++) rest.emplace_back(Point2D(x0 + c * spacing, y0 + r * spacing));
    ICGN2D1 first(radius, radius, 0.001f, 10, threads);
    ICGN2D2 second(radius, radius, 0.001f, 10, threads);

    vector<POI2D> across = rest, along;
    start(one, two, radius, threads, across);
    refine(second, one, two, across);
    vector<char> matched(rest.size(), 1);
    vector<Point2D> places1(rest.begin(), rest.end()), places2 = moved(across, matched);
    for (int n = 0; n <= steps; n++) {
        vector<char> good = matched;
        if (n > 0) {
            Image2D now1(files1[n]), now2(files2[n]);
            if (n == 1) {
                along = rest;
                start(one, now1, radius, threads, along);
            }
            refine(first, one, now1, along);
            refine(second, one, now2, across);  // from the result of the step before
            places1 = moved(along, good);
            places2 = moved(across, good);
        }
        vector<Point3D> xyz(rest.size(), Point3D());
        stereo.reconstruct(places1, places2, xyz);
        std::ofstream file(out + "/step_" + std::to_string(n) + ".bin", std::ios::binary);
        for (size_t k = 0; k < xyz.size(); k++) {
            float row[3] = {xyz[k].x, xyz[k].y, xyz[k].z};
            if (!good[k]) row[0] = row[1] = row[2] = NAN;
            file.write(reinterpret_cast<const char*>(row), sizeof row);
        }
    }
    return 0;
}
